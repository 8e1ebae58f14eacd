"""Write the generated parts of docs/components.md: python scripts/write_components.py

These parts are made from the comments in configs/. Each is between two lines, ``<!-- begin generated: NAME
-->`` and ``<!-- end generated -->``. If NAME is a group, the part lists its options and their settings. If
NAME is a command, it lists the settings of the command. Everything around these parts is written by hand.
"""

import re
from collections.abc import Iterable
from pathlib import Path

from cadam3d.settings.documentation import Library, Option, Setting
from cadam3d.settings.options import config_dir

PAGE = Path(__file__).parent.parent / "docs" / "components.md"
PART = re.compile(r"(<!-- begin generated: (\S+) -->\n).*?(<!-- end generated -->)", re.DOTALL)
# Options of these groups are lists of runs and have no settings.
LISTED_ONLY = ("grid",)
# Options of these groups change settings of other groups, which are documented there.
RECIPES = ("experiment", "noise", "vram", "for")


def main() -> None:
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


def written(text: str) -> str:
    """Return the page with all generated parts brought up to date."""
    library = Library([config_dir()])
    chosen = {group.name: group.chosen for group in library.groups("sweep")}

    def part(match: re.Match[str]) -> str:
        name = match.group(2)
        is_group = name in library.options
        body = (
            group(library, name, chosen.get(name, ())) if is_group else table(library.command(name).settings)
        )
        return f"{match.group(1)}\n{body}\n\n{match.group(3)}"

    return PART.sub(part, text)


def group(library: Library, name: str, chosen: tuple[str, ...]) -> str:
    """Return the table of the options of a group, and under it the settings of each option."""
    options = [library.option(name, each) for each in library.options[name]]
    lines = [f"| `{name}=` | |", "|---|---|"]
    for option in options:
        mark = " (default)" if option.name in chosen else ""
        lines.append(f"| `{option.name}`{mark} | {cell(option.about)} |")
    blocks = ["\n".join(lines)]
    if name not in LISTED_ONLY:
        blocks += [block for option in options if (block := settings(name, option))]
    return "\n\n".join(blocks)


def settings(name: str, option: Option) -> str:
    """Return the settings of an option in a folded section: only the changed ones if it has a base."""
    own = [each for each in option.settings if not option.base or each.key in option.own_keys]
    if not own:
        return ""
    title = f"<code>{name}={option.name}</code>"
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


if __name__ == "__main__":
    main()
