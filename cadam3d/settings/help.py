"""Help: describe groups, options and settings in the words of the YAML files, for the terminal and the site.

The comment beside a key, or directly above it, describes the key. The first comment of a file describes the
option or the command. A key without a comment has the words of the same key in the file that its option
builds on. Nothing is composed and torch is not imported.
"""

import re
import shutil
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any

from cadam3d.core.checks import fail, nearest
from cadam3d.io.reading import read_text, read_yaml
from cadam3d.settings.options import (
    TARGET,
    command_files,
    config_dir,
    default_options,
    option_file,
    option_names,
    package_of,
    read_option,
    spelled,
)

NARROWEST, WIDEST = 60, 120  # characters per line
FIRST_COLUMN = 32  # characters; the description of a longer key begins on the next line
SCHEDULES = "cadam3d.core.schedule."
SENTENCE_END = re.compile(r"(?<=[.!?])(?<!al\.)(?<!sec\.)(?<!fig\.)(?<!eq\.)\s+")
KEY = re.compile(r"(\s*)(\w+):(?=\s|$)(.*)")
# A group in the list of defaults, with the words about it.
ENTRY = re.compile(r"\s*- (?:override )?/?([\w/]+): [^#]*(?:# (.*))?")
COMMENT = re.compile(r"""(?:"[^"]*"|'[^']*'|[^#'"]|(?<=\S)#)*?(?<!\S)# ?(.*)""")


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A key with its value and its description."""

    key: str  # as in a command line, such as "camera.fov_y_deg"
    # As it is typed, or the call that builds an object, such as "Linear(start=0.98, end=0.5, steps=500)".
    value: str
    words: str = ""


@dataclass(frozen=True, kw_only=True)
class Option:
    """An option that ``group=name`` chooses, or a command with its settings outside of all groups."""

    about: str  # paragraphs between empty lines; a line that begins with a space is an example
    base: str = ""  # the option of the same group that this one builds on, or ""
    settings: tuple[Setting, ...]


@dataclass(frozen=True, kw_only=True)
class Choices:
    """A group of options as a command uses it."""

    chosen: tuple[str, ...] = ()  # the default
    words: str = "an option for the setting of this name"


@dataclass(frozen=True)
class Library:
    """All YAML files in some folders, in the order in which Hydra searches them."""

    folders: Sequence[Path]

    @cached_property
    def options(self) -> dict[str, list[str]]:
        """Return the names of the options of each group, without the groups of Hydra itself."""
        files = [path.relative_to(folder) for folder in self.folders for path in folder.glob("*/**/*.yaml")]
        groups = {path.parent.as_posix() for path in files if path.parts[0] != "hydra"}
        # What options build on is in groups whose names begin with an underscore. They are not for choosing.
        groups = {group for group in groups if "/_" not in group}
        return {group: option_names(group, self.folders) for group in sorted(groups)}

    def summary(self, group: str, name: str) -> str:
        """Return the first sentence of the description of an option."""
        first = about_of(option_file(group, name, self.folders)).partition("\n")[0]
        return SENTENCE_END.split(first, maxsplit=1)[0]

    def groups(self, command: str) -> dict[str, Choices]:
        """Return the groups of a command that have options, each followed by the groups inside it."""
        lines = [line for path in command_files(command) for line in read_text(path).splitlines()]
        words = {entry[1]: entry[2] or "" for line in lines if (entry := ENTRY.match(line))}
        groups: dict[str, Choices] = {}
        for name, value in default_options(command).items():
            chosen = value if isinstance(value, list) else [] if value is None else [value]
            inner = {each: Choices() for each in self.options if each.startswith(f"{name}/")}
            if name in self.options:
                groups |= {name: Choices(chosen=tuple(chosen), words=words[name]), **inner}
        return groups

    def command(self, name: str) -> Option:
        """Return a command with its settings outside of all groups."""
        outside = {"defaults", "hydra", *default_options(name)}
        settings: list[Setting] = []
        for path in command_files(name):
            own = {key: value for key, value in read_yaml(path).items() if key not in outside}
            settings += _settings(own, words_in(path))
        return Option(about=about_of(config_dir() / f"{name}.yaml"), settings=tuple(settings))

    def option(self, group: str, name: str) -> Option:
        """Return an option with all its settings, including the settings of the option that it builds on.

        An option may also change settings and groups elsewhere, which are described in their own group.
        """
        path = option_file(group, name, self.folders)
        values = read_option(group, name, self.folders)
        values.pop("hydra", None)
        bases, choices = _defaults(read_yaml(path))
        groups = choices.keys() & self.options.keys()
        chosen = [Setting(key=key, value=spelled(value)) for key, value in choices.items() if key in groups]
        place, notes = package_of(group, path), self._words(group, name)
        words = {".".join([*place, key]): note for key, note in notes.items()}
        base = next((base for base, _ in bases if "/" not in base), "")
        return Option(about=about_of(path), base=base, settings=(*chosen, *_settings(values, words)))

    def _words(self, group: str, name: str) -> dict[str, str]:
        """Return the words in the file of an option and in those that it builds on, by key in the file."""
        path = option_file(group, name, self.folders)
        words: dict[str, str] = {}
        for base, place in _defaults(read_yaml(path))[0]:
            inner, _, option = base.lstrip("/").rpartition("/")
            words |= {place + key: note for key, note in self._words(inner or group, option).items()}
        for key, note in words_in(path).items():
            meaning = words.get(key, "").removesuffix(".")
            words[key] = f"{meaning}. Here: {note}" if meaning and note not in meaning else note
        return words


def help_text(command: str, overrides: Sequence[str], folders: Sequence[Path]) -> str:
    """Return the help of a command, or of the options that the overrides choose, such as ``camera=orbit``.

    A word without ``=`` that names a group lists its options; overrides of single settings are ignored.
    ``folders`` have the YAML files. Raises ``UserError`` for a group or an option that does not exist.
    """
    library = Library(folders)
    groups = library.groups(command)
    parts = []
    for word in overrides:
        name, equals, value = word.lstrip("+").partition("=")
        if name in groups and equals:
            parts += [_option(library, name, each) for each in re.findall(r"\w+", value) if each != "null"]
        elif name in groups:
            parts.append(_group(library, name, groups[name]))
        elif name in library.options or not equals:
            line = f"cadam3d {command} --help {nearest(name, groups)}".rstrip()
            raise fail("--help", expected=f"a group of {command}", got=name, example=line)
    return "\n\n".join(parts or _overview(library, command, groups))


def about_of(path: Path) -> str:
    """Return the first comment of a file: paragraphs in one line each, and lines of examples."""
    lines = [line for line in read_text(path).splitlines() if not line.startswith("# @package ")]
    flowing = [""]
    for line in takewhile(lambda line: line.startswith("#"), lines):
        words = line[1:].removeprefix(" ").rstrip()
        if words and flowing[-1] and not words.startswith(" ") and not flowing[-1].startswith(" "):
            flowing[-1] += " " + words
        else:
            flowing.append(words)
    return "\n".join(flowing).strip("\n")


@cache
def words_in(path: Path) -> dict[str, str]:
    """Return the descriptions of the keys in a YAML file by dotted key, without those that have none."""
    found: dict[str, str] = {}
    parents: list[tuple[int, str]] = []  # columns and keys of the dicts around a line
    above: list[str] = []
    is_header = True
    for line in read_text(path).splitlines():
        is_header = is_header and line.startswith("#")
        if line.lstrip().startswith("#") and not is_header:
            above.append(line.lstrip("# "))
            continue
        if match := KEY.match(line):
            column, key = len(match[1]), match[2]
            parents = [parent for parent in parents if parent[0] < column] + [(column, key)]
            comment = COMMENT.match(match[3])
            words = " ".join(above)
            if comment:
                words = f"{words} {comment[1][0].upper()}{comment[1][1:]}" if words else comment[1]
            if words:
                found[".".join(name for _, name in parents)] = words
        above = []
    return found


def _defaults(content: Any) -> tuple[list[tuple[str, str]], dict[str, Any]]:
    """Return the files in the list of defaults of a file, each with its place, and the choices of groups."""
    entries = content.get("defaults", ())
    bases = [each.split("@") for each in entries if isinstance(each, str) and each != "_self_"]
    places = [(base, f"{place[0]}." if place and place != ["_here_"] else "") for base, *place in bases]
    pairs = [pair for entry in entries if isinstance(entry, dict) for pair in entry.items()]
    return places, {key.removeprefix("override ").lstrip("/"): value for key, value in pairs}


def _settings(values: dict[str, Any], words: Mapping[str, str], prefix: str = "") -> Iterator[Setting]:
    """Yield the settings in nested values, schedules as a whole, and groups of keys with a description."""
    for name, value in values.items():
        key = f"{prefix}{name}"
        target = str(value.get(TARGET, "")) if isinstance(value, dict) else ""
        is_branch = isinstance(value, dict) and not (target and prefix and key in words)
        if name != TARGET and (not is_branch or key in words):
            yield Setting(key=key, value="" if is_branch else _spelled(value), words=words.get(key, ""))
        if isinstance(value, dict) and not target.startswith(SCHEDULES):
            yield from _settings(value, words, f"{key}.")


def _spelled(value: Any) -> str:
    """Return a value as a command line spells it, or the call that builds an object."""
    if not isinstance(value, dict):
        return spelled(value) or '""'
    target = str(value.get(TARGET, ""))
    inner = ", ".join(f"{key}={_spelled(each)}" for key, each in value.items() if key != TARGET)
    return f"{target.rpartition('.')[2]}({inner if target.startswith(SCHEDULES) else '...'})"


def _overview(library: Library, command: str, groups: dict[str, Choices]) -> list[str]:
    """Return the purpose of a command, its settings, and its groups with their options."""
    about = library.command(command)
    parts = [_wrapped(about.about), f"Settings (key=value):\n{_table(map(_row, about.settings))}"]
    if groups:
        intro = _wrapped("Parts (group=option, or 'group=[one,two]'). * marks what is chosen by default.")
        parts += [intro, *(_group(library, name, group) for name, group in groups.items())]
        example = next(f"{name}={group.chosen[0]}" for name, group in groups.items() if group.chosen)
        parts.append(_wrapped(f"More: cadam3d {command} --help {example}, or cadam3d {command} --cfg job."))
    return parts


def _group(library: Library, name: str, group: Choices) -> str:
    """Return the text for a group, with one line for each option; a star marks the default."""
    rows = [
        (f"{'*' if each in group.chosen else ' '} {each}", library.summary(name, each))
        for each in library.options[name]
    ]
    return f"{_wrapped(f'{name}: {group.words}')}\n{_table(rows)}"


def _option(library: Library, group: str, name: str) -> str:
    """Return the text for an option and its settings. Raises ``UserError`` if there is no such option."""
    option = library.option(group, name)
    lines = [f"{group}={name}", _wrapped(option.about)]
    if option.base:
        base = library.option(group, option.base).settings
        changed = [each.key.removeprefix(f"{group}.") for each in option.settings if each not in base]
        lines.append(_wrapped(f"Builds on {group}={option.base} and changes {', '.join(changed)}."))
    return "\n".join([*lines, _table(map(_row, option.settings)) or "  It has no settings."])


def _row(setting: Setting) -> tuple[str, str]:
    """Return a setting as it is typed, and its words."""
    sign = "" if not setting.value else ": " if setting.value.endswith(")") else "="
    return f"  {setting.key}{sign}{setting.value}", setting.words


def _table(rows: Iterable[tuple[str, str]]) -> str:
    """Return a table of two columns, the second of which is wrapped."""
    blocks, blank = [], " " * FIRST_COLUMN
    for first, second in rows:
        fits = len(first) <= FIRST_COLUMN - 2
        text = _wrapped(second, blank)
        blocks.append(first.ljust(FIRST_COLUMN) + text[FIRST_COLUMN:] if fits else f"{first}\n{text}")
    return "\n".join(block.rstrip() for block in blocks)


def _wrapped(text: str, indent: str = "") -> str:
    """Return a text in lines of the terminal, except those that begin with a space; words stay whole."""
    width = min(max(shutil.get_terminal_size((100, 24)).columns, NARROWEST), WIDEST)
    wrapper = textwrap.TextWrapper(width, indent, indent, break_long_words=False, break_on_hyphens=False)
    return "\n".join(line if line.startswith(" ") else wrapper.fill(line) for line in text.splitlines())
