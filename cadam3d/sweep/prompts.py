"""Prompts: read the prompts of a sweep from a file, or from a set that comes with this package.

A prompt may come with settings for its own jobs, such as a negative prompt, and with a category by which
tables can be split. The file may come from a stranger. It is read as plain data, and a mistake in it is
reported in one message that names the line.
"""

import json
import re
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml  # comes with OmegaConf

from cadam3d.core.checks import fail, require, require_whole
from cadam3d.core.errors import UserError
from cadam3d.io.prompts import set_file, set_names
from cadam3d.io.reading import parse_yaml, read_bytes
from cadam3d.io.run_folder import expanded
from cadam3d.settings.advice import did_you_mean
from cadam3d.settings.check import is_readable

KEY, FILE = "prompts", "prompts.file"
SHARD, CATEGORY, FIRST = "prompts.shard", "prompts.category", "prompts.first"
# The setting of a run for each key of an entry, besides the prompt.
SETTINGS = {"negative_prompt": "negative_prompt", "initializer_prompt": "initializer.prompt"}
ENTRY = ("prompt", *SETTINGS, "name", "category")
TREES = (".yaml", ".yml", ".json")
PLAIN = (".txt", ".text", "")
LARGEST = 1 << 22  # bytes of a file
MOST = 10_000  # prompts in a file
# Characters of a prompt. The longest that a text encoder reads is far shorter, and a word of a command line
# must not be longer than 128 KiB on Linux.
LONGEST = 10_000
SHARDS = re.compile(r"0*([1-9][0-9]{0,5})/0*([1-9][0-9]{0,5})", re.ASCII)
# Composite prompts of threestudio refer to its own library in this way, by some words of a prompt.
REFERENCE = "lib:"


@dataclass(frozen=True, kw_only=True)
class Prompt:
    """One prompt of a sweep, with further settings of its jobs."""

    text: str
    settings: tuple[tuple[str, str], ...] = ()  # keys and values
    name: str = ""
    category: str = ""


@dataclass(frozen=True, kw_only=True)
class PromptChoice:
    """The prompts that a line chooses: a file or a set, and which part of it."""

    source: str  # as it was typed
    category: str | None  # None: all
    first: int | None  # how many; None: all
    shard: tuple[int, int] | None  # which one, from 1 on, of how many

    @property
    def title(self) -> str:
        """Return a short name of the file or the set, and of the category."""
        return " ".join([Path(self.source).stem, *([self.category] if self.category else [])])

    @property
    def identity(self) -> str:
        """Return a text that differs between choices, apart from their shards."""
        parts = (str(Path(self.source)), (self.category or "").casefold(), self.first)
        return f"{KEY}={json.dumps(parts)}"

    def read(self) -> tuple[Prompt, ...]:
        """Return the chosen prompts: those of the category, the first of these, and of these the shard.

        Shards are consecutive and differ in length by one prompt at most. Raises ``UserError`` if nothing is
        chosen.
        """
        prompts = _of_category(read_prompts(self.source), self.category)[: self.first]
        if self.shard is None:
            return prompts
        number, count = self.shard
        if count > len(prompts):
            expected = f"no more shards than prompts ({len(prompts)})"
            raise fail(SHARD, expected=expected, got=f"{number}/{count}", example=f"{SHARD}=1/{len(prompts)}")
        begin, end = ((number + step) * len(prompts) // count for step in (-1, 0))
        return prompts[begin:end]


def read_choice(node: Mapping[Any, Any] | None, default: str | None = None) -> PromptChoice | None:
    """Return the choice that the settings ``prompts.*`` of a sweep describe; None if it has no such prompts.

    ``default`` is the file or set of the grid. Raises ``UserError`` for wrong values.
    """
    node = dict(node or {})
    source, shard, first = node.get("file"), node.get("shard"), node.get("first")
    category = node.get("category")
    source = default if source is None else source
    if source is None:
        for name in ("shard", "category", "first"):
            if node.get(name) is not None:
                typed = f"{KEY}={set_names()[0]} {shlex.quote(f'{KEY}.{name}={node[name]}')}"
                raise fail(f"{KEY}.{name}", expected=f"{KEY}=FILE too", got=node[name], example=typed)
        return None
    is_source = isinstance(source, str) and bool(source.strip())
    require(is_source, KEY, expected=_file_or_set(), got=source, example=f"{KEY}={set_names()[0]}")
    if first is not None:
        require_whole(FIRST, first, low=1, example=6)
    if category is not None:
        is_text = isinstance(category, str) and bool(category.strip())
        require(is_text, CATEGORY, expected="a category", got=category, example=f"{CATEGORY}=Material")
        category = category.strip()
    return PromptChoice(source=source, category=category, first=first, shard=_shard(shard))


def read_prompts(source: str) -> tuple[Prompt, ...]:
    """Return the prompts of a set, or of the file at the path ``source``. Repeated entries count once.

    Raises ``UserError``, which names the line, for anything that is not a prompt, and if a prompt has two
    different entries.
    """
    path = _find(source)
    text = _decoded(path)
    if path.suffix.lower() in TREES:
        entries = list(_entries(_tree(path, text)))
    else:
        lines = [(number, line.strip()) for number, line in enumerate(text.split("\n"), start=1)]
        entries = [
            (_Node(f"{path}, line {number}", line), "") for number, line in lines if line and line[0] != "#"
        ]
    if not entries:
        raise _refusal(str(path), "prompts", "none")
    if len(entries) > MOST:
        raise _refusal(str(path), f"at most {MOST} prompts", len(entries))
    found: dict[str, tuple[Prompt, str]] = {}
    for node, category in entries:
        prompt = _prompt(node, category)
        first, place = found.setdefault(prompt.text, (prompt, node.place))
        if first != prompt:
            where = place.removeprefix(f"{path}, ")
            expected = f"what {where} says about this prompt too, or another prompt"
            raise _refusal(node.place, expected, _quoted(prompt.text))
    return tuple(prompt for prompt, _ in found.values())


def _of_category(prompts: tuple[Prompt, ...], category: str | None) -> tuple[Prompt, ...]:
    """Return the prompts of a category, in upper or lower case; None means all prompts."""
    if category is None:
        return prompts
    chosen = tuple(each for each in prompts if each.category.casefold() == category.casefold())
    if not chosen:
        known = list(dict.fromkeys(each.category for each in prompts if each.category))
        if not known:
            expected = "a file in which prompts have categories"
            raise fail(CATEGORY, expected=expected, got=category, example=f"{KEY}={set_names()[0]}")
        example = shlex.quote(f"{CATEGORY}={(did_you_mean(category, known) or known)[0]}")
        raise fail(CATEGORY, expected=f"one of {'|'.join(known)}", got=category, example=example)
    return chosen


@dataclass(frozen=True)
class _Node:
    """A value in a file, with its place for messages."""

    place: str  # file and line
    content: Any  # text, None, a list of nodes, a dict of nodes; anything else is a mistake
    written: str = field(default="", compare=False)  # the value in messages, if it is not text


def _shown(node: _Node) -> str:
    """Return a value of a file for a message."""
    if node.content is None:
        return "nothing"
    return _quoted(node.content) if isinstance(node.content, str) else node.written


def _find(source: str) -> Path:
    """Return the path of a set or of a file. A name without a suffix is first looked for among the sets."""
    if source in set_names():
        return set_file(source)
    path = expanded(source)
    try:
        exists = path.exists()
    except (OSError, ValueError):
        exists = False
    if not exists:
        near = (did_you_mean(Path(source).stem, set_names()) or set_names())[0]
        raise fail(KEY, expected=_file_or_set(), got=source, example=f"{KEY}={near}")
    if path.suffix.lower() not in (*TREES, *PLAIN):
        suffixes = ", ".join([*(suffix for suffix in (*PLAIN, *TREES) if suffix), "or none"])
        raise _refusal(str(path), f"a file with one of the suffixes {suffixes}", _quoted(path.suffix))
    return path


def _file_or_set() -> str:
    return f"a file, or one of the sets {'|'.join(set_names())}"


def _shard(value: Any) -> tuple[int, int] | None:
    if value is None:
        return None
    match = SHARDS.fullmatch(value) if isinstance(value, str) else None
    number, count = map(int, match.groups()) if match else (1, 0)
    expected = "i/n, with i from 1 to n"
    require(number <= count, SHARD, expected=expected, got=value, example=f"{SHARD}=1/4")
    return number, count


def _refusal(place: str, expected: str, got: object) -> UserError:
    """Return the error about a file. It proposes a set of this package, which can always be read."""
    return UserError(f"{KEY}: {place}: expected {expected}, got {got}. Try: {KEY}={set_names()[0]}")


def _quoted(text: str) -> str:
    """Return a piece of a file for a message."""
    return repr(f"{text[:60]}..." if len(text) > 60 else text)


def _decoded(path: Path) -> str:
    r"""Return the text of a file, with ``\n`` at the end of its lines and without a byte order mark."""
    content = read_bytes(path, largest=LARGEST)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        wrong = f"the byte 0x{content[error.start]:02x}"
        raise _refusal(f"{path}, line {line}", "UTF-8 text", wrong) from error
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if not is_readable(text):
        lines = enumerate(text.split("\n"), start=1)
        number, line = next((number, line) for number, line in lines if not is_readable(line))
        raise _refusal(f"{path}, line {number}", "text without control characters", _quoted(line))
    return text


def _tree(path: Path, text: str) -> _Node:
    """Return the content of a YAML or a JSON file."""
    kind = "JSON" if path.suffix.lower() == ".json" else "YAML"
    try:
        if kind == "YAML":
            return _from_yaml(parse_yaml(text), str(path))
        return _from_json(json.loads(text, object_pairs_hook=_without_repetition), str(path))
    except UserError:
        raise
    # Numbers with thousands of digits raise ValueError, as syntax errors of JSON do.
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = mark.line + 1 if mark is not None else getattr(error, "lineno", None)
        place = str(path) if line is None else f"{path}, line {line}"
        reason = getattr(error, "problem", None) or getattr(error, "msg", None) or str(error)
        reason = " ".join(str(reason).split())[:120]
        raise _refusal(place, f"plain {kind}", f"something else ({reason})") from error


def _from_yaml(node: yaml.Node | None, file: str) -> _Node:
    """Return a node of YAML with its line. Every value except null is text, as it is spelled."""
    if node is None:
        return _Node(file, None)
    place = f"{file}, line {node.start_mark.line + 1}"
    if isinstance(node, yaml.SequenceNode):
        return _Node(place, [_from_yaml(item, file) for item in node.value], "a list")
    if isinstance(node, yaml.MappingNode):
        content: dict[str, _Node] = {}
        for key, value in node.value:
            where = f"{file}, line {key.start_mark.line + 1}"
            if not isinstance(key, yaml.ScalarNode):
                raise _refusal(where, "a key", "a list or a mapping")
            if key.value in content:
                raise _refusal(where, "each key once", _quoted(key.value))
            content[key.value] = _from_yaml(value, file)
        return _Node(place, content, "keys and values")
    return _Node(place, None if node.tag == "tag:yaml.org,2002:null" else node.value)


def _from_json(value: Any, place: str) -> _Node:
    """Return a value of JSON. Its place counts the entries of lists, because the reader knows no lines."""
    if isinstance(value, list):
        items = [_from_json(item, f"{place}, entry {number}") for number, item in enumerate(value, start=1)]
        return _Node(place, items, "a list")
    if isinstance(value, dict):
        content = {key: _from_json(item, f"{place}, {key[:40]!r}") for key, item in value.items()}
        return _Node(place, content, "keys and values")
    return _Node(place, value, "" if isinstance(value, str) else json.dumps(value))


def _without_repetition(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """Return a dict of the pairs. Raises ``ValueError`` for a key that occurs twice."""
    repeated = [key for key, count in Counter(key for key, _ in pairs).items() if count > 1]
    if repeated:
        raise ValueError(f"the key {repeated[0][:40]!r} twice")
    return dict(pairs)


def _entries(root: _Node) -> Iterator[tuple[_Node, str]]:
    """Yield the entries of a list, or of named lists, each with its category.

    If there are several lists, as in a prompt library of threestudio, the name of each is the category of its
    entries.
    """
    lists = root.content if isinstance(root.content, dict) else {"": root}
    for name, node in lists.items():
        if not isinstance(node.content, list):
            expected = "a list of prompts, or names with lists of prompts"
            raise _refusal(node.place, expected, _shown(node))
        category = _text(_Node(node.place, name), "a category as the name") if len(lists) > 1 else ""
        for item in node.content:
            yield item, category


def _prompt(node: _Node, category: str) -> Prompt:
    """Return the prompt of an entry: a text, or keys with a text for each."""
    if not isinstance(node.content, dict):
        return Prompt(text=_text(node, "a prompt"), category=category)
    for key, value in node.content.items():
        if key not in ENTRY:
            near = did_you_mean(key, ENTRY)
            meant = f" (did you mean {near[0]}?)" if near else ""
            raise _refusal(value.place, f"one of the keys {', '.join(ENTRY)}{meant}", _quoted(key))
    given = {key: value for key, value in node.content.items() if value.content is not None}
    if "prompt" not in given:
        raise _refusal(node.place, "the key prompt", "|".join(node.content) or "none")
    settings = [
        (SETTINGS[key], _text(given[key], key, may_be_empty=key == "negative_prompt"))
        for key in SETTINGS
        if key in given
    ]
    return Prompt(
        text=_text(given["prompt"], "a prompt"),
        settings=tuple(settings),
        name=_text(given["name"], "a name") if "name" in given else "",
        category=_text(given["category"], "a category") if "category" in given else category,
    )


def _text(node: _Node, what: str, *, may_be_empty: bool = False) -> str:
    """Return the text of a node without blanks around it. Raises ``UserError`` if it cannot be ``what``."""
    if not isinstance(node.content, str):
        raise _refusal(node.place, f"{what} as text", _shown(node))
    text = node.content.strip()
    if not (text or may_be_empty):
        raise _refusal(node.place, what, _quoted(text))
    if len(text) > LONGEST:
        raise _refusal(node.place, f"{what} of at most {LONGEST} characters", len(text))
    if not is_readable(text):
        raise _refusal(node.place, f"{what} without control characters", _quoted(text))
    if text.startswith(REFERENCE):
        expected = f"{what}, and not a reference to threestudio's library"
        raise _refusal(node.place, expected, _quoted(text))
    if text == "???":
        raise _refusal(node.place, what, _quoted(text))
    return text
