"""Help page: the output of ``cadam3d COMMAND --help``, generated from the comments in the YAML files.

Nothing is composed and torch is not imported, so the page appears at once.
"""

import re
import shutil
import textwrap
from argparse import Namespace
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from cadam3d.core.errors import UserError
from cadam3d.settings.advice import did_you_mean
from cadam3d.settings.documentation import Group, Library, Setting
from cadam3d.settings.options import config_dir

NARROWEST, WIDEST = 60, 120  # characters per line
# Characters. The description of a longer key begins on the next line.
FIRST_COLUMN = 34
NAME = re.compile(r"\w+")


def help_text(command: str, overrides: Sequence[str], options: Namespace) -> str:
    """Return the help of a command, or of the options that the overrides choose, such as ``camera=orbit``.

    A word without ``=`` that names a group lists its options; overrides of single settings are ignored.
    ``options`` are the flags of the line, of which ``--config-path`` and ``--config-dir`` name folders of
    YAML files. Raises ``UserError`` for a group or an option that does not exist.
    """
    folders = [Path(options.config_path) if options.config_path else config_dir()]
    folders += [Path(options.config_dir)] if options.config_dir else []
    library = Library(folders)
    config_name = options.config_name or command
    groups = {group.name: group for group in _groups(library, config_name)}
    width = min(max(shutil.get_terminal_size((100, 24)).columns, NARROWEST), WIDEST)
    parts = []
    for word in overrides:
        name, equals, value = word.lstrip("+").partition("=")
        if name in groups and equals:
            chosen = [option for option in NAME.findall(value) if option != "null"]
            parts += [_option(library, command, name, option, width) for option in chosen]
        elif name in groups:
            parts += [_group(library, groups[name], width), _hint(command, groups[name], width)]
        elif name in library.options or not equals:
            raise _no_group(command, word, groups)
    return "\n\n".join(parts) if parts else _overview(library, command, config_name, groups, width)


def _groups(library: Library, command: str) -> Iterator[Group]:
    """Yield the groups of a command that have options, each followed by the groups inside it."""
    for group in library.groups(command):
        if group.name in library.options:
            yield group
        for name in library.options:
            outer, _, inner = name.rpartition("/")
            if outer == group.name:
                pages = [library.page(f"{outer}/{option}") for option in library.options[outer]]
                owners = [page for page in pages if inner in [each.name for each in page.groups]]
                words = " ".join(page.words.get(inner, "") for page in owners)
                yield Group(name=name, chosen=(), is_list=False, words=words)


def _overview(library: Library, command: str, config_name: str, groups: dict[str, Group], width: int) -> str:
    """Return the purpose of a command, its settings, and its groups with their options."""
    about = library.command(config_name)
    parts = [_paragraphs(about.about, width)]
    if about.settings:
        parts.append("Settings (key=value):\n" + _settings(about.settings, width))
    if groups:
        lists = [f"'{group.name}=[{','.join(group.chosen)}]'" for group in groups.values() if group.is_list]
        note = f"; a list needs quotes, as in {lists[0]}" if lists else ""
        title = f"Parts (group=option{note}). * marks what is chosen by default."
        parts.append(_fill(title, width))
    parts += [_group(library, group, width) for group in groups.values()]
    if groups:
        parts.append(_hint(command, groups.get("densifier") or next(iter(groups.values())), width))
    return "\n\n".join(parts)


def _group(library: Library, group: Group, width: int) -> str:
    """Return the text for a group, with one line for each option."""
    names = library.options[group.name]
    rows = [
        (("* " if name in group.chosen else "  ") + name, library.summary(group.name, name)) for name in names
    ]
    title = f"{group.name}: {group.words}" if group.words else group.name
    return "\n".join(
        [
            _fill(title, width, indent="  "),
            *_table(rows, width, narrow=True),
        ]
    )


def _option(library: Library, command: str, group: str, name: str, width: int) -> str:
    """Return the text for an option and its settings. Raises ``UserError`` if there is no such option."""
    if name not in library.options[group]:
        names = library.options[group]
        best = (did_you_mean(name, names) or names)[0]
        raise UserError(
            f"{group}: expected one of {'|'.join(names)}, got {name!r}. "
            f"Try: cadam3d {command} --help {group}={best}"
        )
    option = library.option(group, name, command)
    title = f"{group}={name}" + (f" ({option.target})" if option.target else "")
    lines = [title, _paragraphs(option.about, width)]
    if option.base:
        changed = [each.key for each in option.settings if each.key in option.own_keys]
        whole = [key for key in changed if key.rpartition(".")[0] not in changed]
        names = ", ".join(key.removeprefix(f"{group}.") for key in whole)
        lines.append(_fill(f"Builds on {group}={option.base} and changes {names}.", width))
    return "\n".join([*lines, _settings(option.settings, width) or "  It has no settings."])


def _settings(settings: Iterable[Setting], width: int) -> str:
    """Return a table with one row for each setting, under the key of the command line."""
    rows = []
    for each in settings:
        sign = ": " if each.is_object and each.value else "" if each.is_object else "="
        rows.append((f"  {each.key}{sign}{each.value}", each.words))
    return "\n".join(_table(rows, width))


def _table(rows: Sequence[tuple[str, str]], width: int, *, narrow: bool = False) -> Iterator[str]:
    """Yield the lines of a table of two columns, the second of which is wrapped."""
    column = min(max((len(first) for first, _ in rows), default=0), 24 if narrow else FIRST_COLUMN) + 2
    for first, second in rows:
        lines = textwrap.wrap(second, width - column, break_long_words=False, break_on_hyphens=False)
        if len(first) > column - 2:
            yield first
        else:
            yield (first.ljust(column) + (lines.pop(0) if lines else "")).rstrip()
        yield from (" " * column + line for line in lines)


def _paragraphs(text: str, width: int) -> str:
    """Wrap each line of a text, except those that begin with a space."""
    lines = text.splitlines()
    return "\n".join(line if line.startswith(" ") else _fill(line, width) for line in lines)


def _hint(command: str, group: Group, width: int) -> str:
    """Return a hint about the pages with more details."""
    example = group.chosen[0] if group.chosen else "NAME"
    text = (
        f"cadam3d {command} --help {group.name}={example} lists the settings of an option. "
        f"cadam3d {command} --cfg job prints the settings that a command line runs with."
    )
    return _fill(text, width)


def _no_group(command: str, word: str, groups: dict[str, Group]) -> UserError:
    """Return the error for a word that is not a group of the command."""
    name = word.partition("=")[0].partition(".")[0]
    near = [name] if name in groups else did_you_mean(name, list(groups))
    if not groups:
        return UserError(f"{word!r}: cadam3d {command} has no groups. Try: cadam3d {command} --help")
    return UserError(
        f"{word!r}: expected a group of cadam3d {command} ({', '.join(groups)}). "
        f"Try: cadam3d {command} --help {(near or list(groups))[0]}"
    )


def _fill(text: str, width: int, *, indent: str = "") -> str:
    """Return ``text`` in lines of at most ``width`` characters, the later ones indented; words stay whole."""
    return textwrap.fill(text, width, subsequent_indent=indent, break_on_hyphens=False)
