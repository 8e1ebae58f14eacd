"""Documentation: read the descriptions of settings and options from the comments in the YAML files.

The comment beside a key, or directly above it, describes the key. The first comment of a file describes the
option. The help of the command line and ``docs/components.md`` are both generated from these descriptions,
so there is no second copy that could disagree. In the code, ``words`` is the description of a key.

A file that builds on another one (``defaults: [cadam, _self_]``) inherits its descriptions, and a comment
beside a key that it repeats is a note about the new value. A key without a comment has the description of the
same key in another component of the same class in its group.
"""

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml  # comes with OmegaConf

from cadam3d.core.errors import UserError

SCHEDULES = "cadam3d.core.schedule."  # schedules are documented once, in docs/components.md
SENTENCE_END = re.compile(r"(?<=[.!?])(?<!al\.)(?<!sec\.)(?<!fig\.)(?<!eq\.)\s+")
COMMENT = re.compile(r"(?<!\S)#")

Value = Any  # text as YAML spells it (numbers, null and true too), or lists and dicts of such text


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A key with its value and its description."""

    key: str  # as in a command line, such as "camera.fov_y_deg"
    # As YAML spells it, or the call that builds an object, such as "Linear(start=0.98, end=0.5, steps=500)".
    value: str
    words: str
    is_object: bool  # the value is an object or a group of keys, with settings of its own


@dataclass(frozen=True, kw_only=True)
class Option:
    """An option that ``group=name`` chooses, or a command with its settings outside of all groups."""

    name: str
    about: str  # paragraphs between empty lines; a line that begins with a space is an example
    target: str  # the class, such as "cadam3d.camera.orbit.Orbit", or ""
    base: str  # the option of the same group that this one builds on, or ""
    settings: tuple[Setting, ...]
    own_keys: frozenset[str]  # keys and groups to which the file itself gives a value, not its base


@dataclass(frozen=True, kw_only=True)
class Group:
    """A group of options as a command uses it."""

    name: str  # such as "camera", or "initializer/fallback" for a group inside a group
    chosen: tuple[str, ...]  # the default
    is_list: bool  # several options can be chosen
    words: str


@dataclass(frozen=True, kw_only=True)
class Page:
    """One YAML file: its values as they are spelled, and the comments that belong to its keys."""

    package: str  # named in the first line; else ""
    about: str
    values: dict[str, Value]
    words: dict[str, str]  # by dotted key
    groups: tuple[Group, ...]  # in the list of defaults
    bases: tuple[str, ...]  # other files in the list of defaults, such as "cadam"


class Library:
    """All YAML files in some folders. If two folders have a file of the same name, the first one is used."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self.folders = folders
        self._pages: dict[str, Page] = {}
        self._words: dict[str, dict[tuple[str, str], str]] = {}  # see _group_words

    @cached_property
    def options(self) -> dict[str, list[str]]:
        """Return the names of the options of each group, without the groups of Hydra itself."""
        names: dict[str, set[str]] = {}
        for folder in self.folders:
            for path in folder.glob("*/**/*.yaml"):
                names.setdefault(path.parent.relative_to(folder).as_posix(), set()).add(path.stem)
        return {group: sorted(names[group]) for group in sorted(names) if _head(group, "/") != "hydra"}

    def page(self, name: str) -> Page:
        """Return the file ``name``, such as ``train`` or ``camera/orbit``."""
        if name not in self._pages:
            path = self._find(name)
            try:
                self._pages[name] = read_page(path.read_text(encoding="utf-8"))
            except yaml.YAMLError as error:
                reason = " ".join(str(error).split())
                raise UserError(
                    f"{path}: expected YAML, got something else ({reason}). Try: cadam3d doctor"
                ) from error
        return self._pages[name]

    def summary(self, group: str, name: str) -> str:
        """Return the first sentence of the description of an option. Only the top of its file is read."""
        return first_sentence(
            _header(self._find(f"{group}/{name}").read_text(encoding="utf-8").splitlines())[1]
        )

    def groups(self, command: str) -> list[Group]:
        """Return the groups that a command uses. Those of the command that it builds on come first."""
        page = self.page(command)
        inherited = [group for base in page.bases for group in self.groups(base)]
        return [*inherited, *(group for group in page.groups if group.name != "hydra")]

    def command(self, name: str) -> Option:
        """Return a command with its settings outside of all groups."""
        page = self.page(name)
        in_groups = {group.name for group in self.groups(name)} | {"hydra"}
        own = [each for each in settings_of(page.values, page.words) if _head(each.key) not in in_groups]
        inherited = [each for base in page.bases for each in self.command(base).settings]
        own_keys = frozenset(each.key for each in own)
        return Option(
            name=name, about=page.about, target="", base="", settings=(*inherited, *own), own_keys=own_keys
        )

    def option(self, group: str, name: str, command: str = "train") -> Option:
        """Return an option with all its settings, including those of the option that it builds on.

        A recipe changes settings of other groups. Their descriptions are those that they have in ``command``.
        """
        page = self.page(f"{group}/{name}")
        values, words = self._resolved(group, name)
        prefix = {"": group.replace("/", "."), "_global_": ""}.get(page.package, page.package)
        settings = [each for each in settings_of(values, words, prefix) if _head(each.key) != "hydra"]
        if page.package == "_global_":
            settings = self._recipe(page, settings, command)
        target = values.get("_target_", "")
        return Option(
            name=name,
            about=page.about,
            target=target if isinstance(target, str) else "",
            base=next((base for base in page.bases if "/" not in base), ""),
            settings=tuple(settings),
            own_keys=frozenset(
                [
                    *(f"{prefix}.{key}".lstrip(".") for key, *_ in _flat(page.values)),
                    *(each.name for each in page.groups),
                ]
            ),
        )

    def _find(self, name: str) -> Path:
        for folder in self.folders:
            if (path := folder / f"{name}.yaml").is_file():
                return path
        places = " or ".join(map(str, self.folders))
        raise UserError(f"{name}.yaml: expected this file in {places}, got none. Try: cadam3d doctor")

    def _resolved(self, group: str, name: str) -> tuple[dict[str, Value], dict[str, str]]:
        """Return the values and descriptions of an option, merged with those of its base."""
        page = self.page(f"{group}/{name}")
        values, words = page.values, page.words
        for base in page.bases:
            place, _, base_name = base.rpartition("/")
            base_values, base_words = self._resolved(place or group, base_name)
            if page.package == "_global_":
                base_values = {group: base_values}
                base_words = {f"{group}.{key}": each for key, each in base_words.items()}
            values = _merged(base_values, values)
            notes = {key: _with_note(base_words.get(key, ""), note) for key, note in words.items()}
            words = base_words | notes
        known = self._group_words(_head(group, "/")) | _words_by_class(values, words)
        for key, target in _keys_by_class(values):
            meaning = known.get((target, key.rpartition(".")[2]))
            if key not in words and meaning:
                words = words | {key: meaning}
        return values, words

    def _group_words(self, group: str) -> dict[tuple[str, str], str]:
        """Return the descriptions of keys in a group by class and key; the first file takes precedence."""
        if group not in self._words:
            places = [place for place in self.options if _head(place, "/") == group]
            pages = [self.page(f"{place}/{name}") for place in places for name in self.options[place]]
            self._words[group] = {}
            for page in pages:
                if not page.bases:
                    self._words[group] = _words_by_class(page.values, page.words) | self._words[group]
        return self._words[group]

    def _recipe(self, page: Page, settings: Sequence[Setting], command: str) -> list[Setting]:
        """Return the options and settings that a recipe changes, with their descriptions."""
        groups = [group for group in page.groups if _head(group.name, "/") != "hydra"]
        chosen = {group.name: group.chosen for group in [*self.groups(command), *groups]}
        known = {each.key: each.words for each in self.command(command).settings}
        for group in {_head(each.key) for each in settings} & set(self.options):
            wanted = {each.key for each in settings if _head(each.key) == group}
            for name in dict.fromkeys([*chosen.get(group, ()), *self.options[group]]):
                if wanted <= set(known):
                    break
                if self.page(f"{group}/{name}").package == "_global_":
                    continue
                known = {each.key: each.words for each in self.option(group, name).settings} | known
        choices = [
            Setting(
                key=group.name,
                value=_spelled(list(group.chosen) if group.is_list else "".join(group.chosen)),
                words=group.words or " ".join(self.summary(group.name, name) for name in group.chosen),
                is_object=False,
            )
            for group in groups
        ]
        changes = [replace(each, words=_with_note(known.get(each.key, ""), each.words)) for each in settings]
        return choices + changes


def read_page(text: str) -> Page:
    """Read values and comments of a YAML file. Raises ``yaml.YAMLError`` if it is not YAML."""
    package, about = _header(text.splitlines())
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    entries = list(_entries(root))
    comments = _comments(text.splitlines(), root)
    words = {key: words for key, node, _ in entries if (words := _words_of(node, comments))}
    groups, bases = [], []
    for key, _, value in entries:
        is_list = key == "defaults" and isinstance(value, yaml.SequenceNode)
        for item in value.value if is_list else []:
            if isinstance(item, yaml.MappingNode):
                groups.append(_group(item, comments))
            elif item.value != "_self_":
                bases.append(_reference(item.value))
    values = _plain(root) if entries else {}
    values.pop("defaults", None)
    return Page(
        package=package, about=about, values=values, words=words, groups=tuple(groups), bases=tuple(bases)
    )


def settings_of(values: dict[str, Value], words: Mapping[str, str], prefix: str = "") -> Iterator[Setting]:
    """Yield the settings in ``values`` in their order, with ``prefix`` before their keys.

    The numbers of a schedule are part of its value. A group of keys is yielded only if it has a description.
    """
    for path, value, parent in _flat(values):
        is_class = isinstance(value, dict) and "_target_" in value
        is_whole_option = parent is values and "_target_" not in values  # such as regularizer.sparsity
        is_branch = isinstance(value, dict) and (is_whole_option or not is_class)
        is_number = str(parent.get("_target_", "")).startswith(SCHEDULES)
        if not (path.endswith("_target_") or is_number or (is_branch and path not in words)):
            yield Setting(
                key=f"{prefix}.{path}" if prefix else path,
                value="" if is_branch else _spelled(value),
                words=words.get(path, ""),
                is_object=isinstance(value, dict),
            )


def first_sentence(about: str) -> str:
    """Return the first sentence of a text."""
    return SENTENCE_END.split(about.partition("\n")[0], maxsplit=1)[0]


@dataclass(frozen=True)
class _Comment:
    """A comment on one line of a file."""

    column: int
    text: str
    is_beside: bool  # follows a key or a value


def _header(lines: Sequence[str]) -> tuple[str, str]:
    """Return the package that the first line of a file names, and the text of the first comment."""
    package = ""
    if lines and lines[0].startswith("# @package "):
        package, lines = lines[0].split()[2], lines[1:]
    block = itertools.takewhile(lambda line: line.startswith("#"), lines)
    return package, _flowing(line[1:].removeprefix(" ").rstrip() for line in block)


def _flowing(lines: Iterable[str]) -> str:
    """Join the lines of each paragraph. Lines that begin with a space are examples and stay separate."""
    flowing = [""]
    for line in lines:
        if line and flowing[-1] and not line.startswith(" ") and not flowing[-1].startswith(" "):
            flowing[-1] += " " + line
        else:
            flowing.append(line)
    return "\n".join(flowing).strip("\n")


def _entries(node: yaml.Node | None, prefix: str = "") -> Iterator[tuple[str, yaml.Node, yaml.Node]]:
    """Yield each key that has a line of its own: its dotted name, its node and the node of its value."""
    if isinstance(node, yaml.MappingNode) and not node.flow_style:
        for key, value in node.value:
            yield prefix + key.value, key, value
            yield from _entries(value, f"{prefix}{key.value}.")


def _comments(lines: Sequence[str], root: yaml.Node | None) -> dict[int, _Comment]:
    """Return the comment of each line that has one."""
    ends: dict[int, int] = {}  # line to the column where its last value ends
    covered: set[int] = set()  # lines inside a value
    for node in _leaves(root):
        start, end = node.start_mark, node.end_mark
        ends[end.line] = max(end.column, ends.get(end.line, 0))
        covered.update(range(start.line, end.line))
    comments = {}
    for number, line in enumerate(lines):
        match = None if number in covered else COMMENT.search(line, ends.get(number, 0))
        if match:
            text = line[match.end() :].strip()
            comments[number] = _Comment(match.start(), text, bool(line[: match.start()].strip()))
    return comments


def _leaves(node: yaml.Node | None) -> Iterator[yaml.Node]:
    """Yield every node whose text contains no comments: plain values and ``[...]`` or ``{...}``."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style:
        for item in node.value:
            for part in item if isinstance(item, tuple) else (item,):
                yield from _leaves(part)
    elif node is not None:
        yield node


def _words_of(key: yaml.Node, comments: Mapping[int, _Comment]) -> str:
    """Return the description of a key: the comment above it, then the one beside it and its further lines."""
    line, column = key.start_mark.line, key.start_mark.column
    above = []
    while (comment := comments.get(line - len(above) - 1)) and comment.column == column:
        above.insert(0, comment.text)
    # The first comment of the file describes the option.
    if len(above) == line:
        above = []
    beside = []
    if (comment := comments.get(line)) and comment.is_beside:
        beside.append(comment.text)
        while (further := comments.get(line + len(beside))) and further.column == comment.column > column:
            if further.is_beside:
                break
            beside.append(further.text)
    parts = [" ".join(part) for part in (above, beside) if part]
    if len(parts) == 2 and parts[0].endswith("."):
        return f"{parts[0]} {parts[1][0].upper()}{parts[1][1:]}"
    return "; ".join(parts)


def _group(item: yaml.MappingNode, comments: Mapping[int, _Comment]) -> Group:
    """Return the group in an entry of a list of defaults."""
    key, value = item.value[0]
    plain = _plain(value)
    chosen = plain if isinstance(plain, list) else [] if plain == "null" else [plain]
    comment = comments.get(key.start_mark.line)
    return Group(
        name=_reference(key.value),
        chosen=tuple(chosen),
        is_list=isinstance(plain, list),
        words=comment.text if comment else "",
    )


def _reference(text: str) -> str:
    """Return the group or file that a list of defaults refers to, without its prefix and package."""
    return text.removeprefix("override ").removeprefix("optional ").partition("@")[0].lstrip("/")


def _plain(node: yaml.Node) -> Value:
    """Return the value of a node with every scalar as it is spelled."""
    if isinstance(node, yaml.MappingNode):
        return {key.value: _plain(value) for key, value in node.value}
    if isinstance(node, yaml.SequenceNode):
        return [_plain(item) for item in node.value]
    is_quoted = isinstance(node, yaml.ScalarNode) and node.style in ("'", '"')
    return f'"{node.value}"' if is_quoted else node.value


def _merged(base: Value, changes: Value) -> Value:
    """Return ``base`` with ``changes``, as Hydra merges them: dicts key by key, other values as a whole."""
    if not isinstance(base, dict) or not isinstance(changes, dict):
        return changes
    return base | {key: _merged(base.get(key), value) for key, value in changes.items()}


def _with_note(meaning: str, note: str) -> str:
    """Return the description of a key with a note about its value; a repetition is left out."""
    if not meaning or not note or note in meaning:
        return meaning or note
    return f"{meaning.removesuffix('.')}. Here: {note}"


def _flat(values: dict[str, Value], prefix: str = "") -> Iterator[tuple[str, Value, dict[str, Value]]]:
    """Yield every dotted key, those of inner dicts too, with its value and the dict that holds it."""
    for key, value in values.items():
        yield prefix + key, value, values
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")


def _keys_by_class(values: dict[str, Value]) -> Iterator[tuple[str, str]]:
    """Yield the dotted keys of all objects except schedules, each with the class of its object."""
    for path, _, parent in _flat(values):
        target = parent.get("_target_", SCHEDULES)
        if not target.startswith(SCHEDULES):
            yield path, target


def _words_by_class(values: dict[str, Value], words: Mapping[str, str]) -> dict[tuple[str, str], str]:
    """Return the descriptions of the keys of objects, by class and key; the first one takes precedence."""
    known: dict[tuple[str, str], str] = {}
    for key, target in _keys_by_class(values):
        if key in words:
            known.setdefault((target, key.rpartition(".")[2]), words[key])
    return known


def _spelled(value: Value) -> str:
    """Return a value as a command line spells it, or the call that builds an object."""
    if isinstance(value, list):
        return f"[{','.join(map(_spelled, value))}]"
    if not isinstance(value, dict):
        return value
    _, _, name = value.get("_target_", "").rpartition(".")
    if name and not value["_target_"].startswith(SCHEDULES):
        return name
    inner = [
        f"{key}{'=' if name else ': '}{_spelled(item)}" for key, item in value.items() if key != "_target_"
    ]
    return f"{name}({', '.join(inner)})" if name else f"{{{', '.join(inner)}}}"


def _head(name: str, separator: str = ".") -> str:
    return name.partition(separator)[0]
