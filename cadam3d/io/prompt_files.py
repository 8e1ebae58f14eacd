"""Prompts: read files of prompts, and the sets of prompts that come with this package.

A prompt may come with settings for its own run, such as a negative prompt, and with a category by which
tables can be split. A file may come from a stranger. It is read as plain data, and a mistake in it is
reported in one message that names the line or the entry.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cadam3d.core.checks import fail, require, require_choice
from cadam3d.io.jsonl import parse_json
from cadam3d.io.reading import is_readable, parse_text_yaml, read_bytes
from cadam3d.io.run_folder import expanded, has_file

SETS = Path(__file__).with_name("prompt_sets")
# The setting of a run for each key of an entry, besides the prompt.
SETTINGS = {"negative_prompt": "negative_prompt", "initializer_prompt": "initializer.prompt"}
ENTRY = ("prompt", *SETTINGS, "name", "category")
JSON, YAML, PLAIN = (".json",), (".yaml", ".yml"), (".txt", ".text", "")
LARGEST = 1 << 22  # bytes of a file
MOST = 10_000  # prompts in a file
# Characters of a prompt. The longest that a text encoder reads is far shorter, and a word of a command line
# must not be longer than 128 KiB on Linux.
LONGEST = 10_000
# Composite prompts of threestudio refer to its own library in this way, by some words of a prompt.
REFERENCE = "lib:"
EXAMPLE = "cadam3d sweep prompts=paper50"


@dataclass(frozen=True, kw_only=True)
class Prompt:
    """One prompt of a file, with further settings of its runs."""

    text: str
    settings: tuple[tuple[str, str], ...] = ()  # keys and values
    name: str = ""
    category: str = ""


def set_names() -> list[str]:
    """Return the names of the sets, in alphabetical order."""
    return sorted(path.stem for path in SETS.glob("*.yaml"))


def read_prompts(source: str, key: str = "prompts") -> tuple[Prompt, ...]:
    """Return the prompts of a set, or of the file at the path ``source``. Repeated entries count once.

    ``key`` is the setting that names the file. Raises ``UserError``, which names the line or the entry, for
    anything that is not a prompt, and if a prompt has two different entries.
    """
    path = _find(source, key)
    found: dict[str, Prompt] = {}
    for place, entry, category in _entries(path, f"{key}: {path}"):
        prompt = _prompt(place, entry, category)
        first = found.setdefault(prompt.text, prompt)
        expected = "the settings that an earlier entry gives this prompt"
        require(first == prompt, place, expected=expected, got=prompt.text, example=EXAMPLE)
    expected = f"from 1 to {MOST} prompts"
    require(1 <= len(found) <= MOST, f"{key}: {path}", expected=expected, got=len(found), example=EXAMPLE)
    return tuple(found.values())


def _find(source: str, key: str) -> Path:
    """Return the path of a set or of a file. A name without a suffix is first looked for among the sets."""
    if source in set_names():
        return SETS / f"{source}.yaml"
    path = expanded(source)
    if not has_file(path):
        expected = f"a file, or one of the sets {'|'.join(set_names())}"
        raise fail(key, expected=expected, got=source, example=f"{key}={set_names()[0]}")
    require_choice(f"{key}: suffix of {path.name}", path.suffix.lower(), [*PLAIN, *YAML, *JSON])
    return path


def _entries(path: Path, place: str) -> Iterator[tuple[str, Any, str]]:
    """Yield the place, the content and the category of each entry of a file.

    If there are several lists, as in a prompt library of threestudio, the name of each is the category of its
    entries.
    """
    suffix, content = path.suffix.lower(), read_bytes(path, largest=LARGEST)
    try:
        # A byte order mark, and every kind of line ends, are accepted.
        text = content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
        if suffix in PLAIN:
            for number, line in enumerate(text.split("\n"), start=1):
                if line.strip() and line.strip()[0] != "#":
                    yield f"{place}, line {number}", line, ""
            return
        root = parse_json(text.encode()) if suffix in JSON else parse_text_yaml(text)
    # A number with thousands of digits raises ValueError.
    except (ValueError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:120]
        raise fail(place, expected="UTF-8 text, plain YAML or JSON", got=reason, example=EXAMPLE) from error
    lists = root if isinstance(root, dict) else {"": root}
    for name, items in lists.items():
        expected = "a list of prompts, or names with lists of prompts"
        require(isinstance(items, list), place, expected=expected, got=items, example=EXAMPLE)
        category = _text(place, name, "the name of a category") if len(lists) > 1 else ""
        for number, item in enumerate(items, start=1):
            yield f"{place}, {f'{name!r}, ' if name else ''}entry {number}", item, category


def _prompt(place: str, entry: Any, category: str) -> Prompt:
    """Return the prompt of an entry: a text, or keys with a text for each."""
    if not isinstance(entry, dict):
        return Prompt(text=_text(place, entry, "a prompt"), category=category)
    for key in entry:
        require_choice(f"{place}: a key", key, ENTRY)
    given = {key: value for key, value in entry.items() if value is not None}
    texts = {key: _text(place, value, key) for key, value in given.items() if key not in SETTINGS}
    require("prompt" in texts, place, expected="the key prompt", got=", ".join(entry), example=EXAMPLE)
    settings = [
        (setting, _text(place, given[key], key, may_be_empty=key == "negative_prompt"))
        for key, setting in SETTINGS.items()
        if key in given
    ]
    return Prompt(
        text=texts["prompt"],
        settings=tuple(settings),
        name=texts.get("name", ""),
        category=texts.get("category", category),
    )


def _text(place: str, value: Any, what: str, *, may_be_empty: bool = False) -> str:
    """Return a text without blanks around it. Raises ``UserError`` if it cannot be ``what``."""
    text = value.strip() if isinstance(value, str) else ""
    is_empty = isinstance(value, str) and not text
    is_plain = is_readable(text) and len(text) <= LONGEST and text != "???" and not text.startswith(REFERENCE)
    expected = f"{what} as plain text of at most {LONGEST} characters"
    got = value[:60] if isinstance(value, str) else value
    is_text = is_plain if text else is_empty and may_be_empty
    require(is_text, place, expected=expected, got=got, example=EXAMPLE)
    return text
