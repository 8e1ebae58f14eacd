"""A hook of MkDocs: the page of components, from the comments in configs/ and the text in components.md.

``mkdocs.yml`` names this file. In components.md, ``{{ NAME }}`` stands for the options of a group and their
settings, or for the settings of a command.
"""

import re
from collections.abc import Iterable
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from cadam3d.settings.help import Library, Option, Setting
from cadam3d.settings.options import config_dir

TEXT = Path(__file__).parent / "components.md"
PART = re.compile(r"^\{\{ (\S+) \}\}$", re.MULTILINE)
# Options of these groups are lists of runs and have no settings.
LISTED_ONLY = ("grid",)
# Options of these groups change settings of other groups, which are documented there.
RECIPES = ("experiment", "noise", "vram", "for")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the page of components."""
    files.append(File.generated(config, "components.md", content=page()))
    return files


def page() -> str:
    """Return the page of components."""
    library = Library([config_dir()])
    chosen = {name: group.chosen for name, group in library.groups("sweep").items()}

    def part(match: re.Match[str]) -> str:
        name = match.group(1)
        if name in library.options:
            return group(library, name, chosen.get(name, ()))
        return table(library.command(name).settings)

    return PART.sub(part, TEXT.read_text(encoding="utf-8"))


def group(library: Library, name: str, chosen: tuple[str, ...]) -> str:
    """Return the table of the options of a group, and under it the settings of each option."""
    options = {each: library.option(name, each) for each in library.options[name]}
    lines = [f"| `{name}=` | |", "|---|---|"]
    for each, option in options.items():
        mark = " (default)" if each in chosen else ""
        lines.append(f"| `{each}`{mark} | {cell(option.about)} |")
    blocks = ["\n".join(lines)]
    if name not in LISTED_ONLY:
        for each, option in options.items():
            base = options[option.base].settings if option.base else ()
            blocks += [block] if (block := settings(name, each, option, base)) else []
    return "\n\n".join(blocks)


def settings(name: str, chosen: str, option: Option, base: tuple[Setting, ...]) -> str:
    """Return the settings of an option in a folded section, without those of the option it builds on."""
    own = [each for each in option.settings if each not in base]
    if not own:
        return ""
    title = f"<code>{name}={chosen}</code>"
    if option.base:
        title += f", otherwise as <code>{option.base}</code>"
    prefix = name.replace("/", ".") + "."
    # Some options, such as prior=shapes_sd, change settings of other groups too.
    is_recipe = name in RECIPES or not all(each.key.startswith(prefix) for each in own)
    body = changes(own) if is_recipe else table(own, prefix)
    return f"<details><summary>{title}</summary>\n\n{body}\n\n</details>"


def table(settings: Iterable[Setting], prefix: str = "") -> str:
    """Return a table of settings; ``prefix`` is left out of the keys."""
    lines = ["| setting | value | meaning |", "|---|---|---|"]
    for each in settings:
        value = f"`{cell(each.value)}`" if each.value else ""
        lines.append(f"| `{each.key.removeprefix(prefix)}` | {value} | {cell(each.words)} |")
    return "\n".join(lines)


def changes(settings: Iterable[Setting]) -> str:
    """Return the options and settings that a recipe changes, as lines of code."""
    lines = [f"    {each.key}={each.value}" for each in settings if each.value]
    return "\n".join(lines)


def cell(text: str) -> str:
    """Return text for a cell of a table."""
    return " ".join(text.split()).replace("|", r"\|").replace("<", "&lt;")
