"""Prompts: read files of prompts, and the sets of prompts that come with this package.

A prompt may come with settings for its own run, such as a negative prompt, and with a category by which
tables can be split. A file may come from a stranger. It is read as plain data, and a mistake in it is
reported in one message that names the line or the entry.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from cadam3d.core.checks import fail, require, require_choice
from cadam3d.io.jsonl import parse_json
from cadam3d.io.reading import is_readable, parse_text_yaml, read_bytes
from cadam3d.io.run_folder import expanded, has_file

SETS = Path(__file__).with_name("prompt_sets")
# The setting of a run for each key of an entry, besides the prompt.
SETTINGS = {"negative_prompt": "negative_prompt", "initializer_prompt": "initializer.prompt"}
JSON, YAML, PLAIN = (".json",), (".yaml", ".yml"), (".txt", ".text", "")
LARGEST = 1 << 22  # bytes of a file
MOST = 10_000  # prompts in a file
# Characters of a prompt. The longest that a text encoder reads is far shorter, and a word of a command line
# must not be longer than 128 KiB on Linux.
LONGEST = 10_000
# Composite prompts of threestudio refer to its own library in this way, by some words of a prompt.
# Three question marks are a missing value of a configuration.
NOT_PROMPTS = ("lib:", "???")
EXAMPLE = "cadam3d sweep prompts=paper50"
KEYS = ", ".join(("prompt", *SETTINGS, "name", "category"))


@dataclass(frozen=True, kw_only=True)
class Prompt:
    """One prompt of a file, with further settings of its runs."""

    text: str
    settings: tuple[tuple[str, str], ...] = ()  # keys and values
    name: str = ""
    category: str = ""


@dataclass(frozen=True, kw_only=True)
class _Entry:
    """The keys of an entry, which pydantic checks."""

    __pydantic_config__: ClassVar = {
        "extra": "forbid",
        "str_strip_whitespace": True,
        "str_max_length": LONGEST,
    }
    prompt: str
    negative_prompt: str | None = None
    initializer_prompt: str | None = None
    name: str | None = None
    category: str | None = None


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
    except (ValueError, TypeError) as error:
        reason = " ".join(str(error).split())[:120]
        raise fail(place, expected="UTF-8 text, plain YAML or JSON", got=reason, example=EXAMPLE) from error
    lists = root if isinstance(root, dict) else {"": root}
    for name, items in lists.items():
        expected = "a list of prompts, or names with lists of prompts"
        require(isinstance(items, list), place, expected=expected, got=items, example=EXAMPLE)
        for number, item in enumerate(items, start=1):
            where = f"{place}, {f'{name!r}, ' if name else ''}entry {number}"
            yield where, item, name if len(lists) > 1 else ""


def _prompt(place: str, entry: Any, category: str) -> Prompt:
    """Return the prompt of an entry: a text, or keys with a text for each."""
    from pydantic import TypeAdapter  # takes a tenth of a second to load

    keys = entry if isinstance(entry, dict) else {"prompt": entry}
    try:
        found = TypeAdapter(_Entry).validate_python({"category": category} | keys)
        texts = [text for text in vars(found).values() if text is not None]
        is_plain = all(is_readable(text) and not text.startswith(NOT_PROMPTS) for text in texts)
        if not found.prompt or not is_plain:
            raise ValueError
    except ValueError as error:
        expected = f"a prompt as plain text of at most {LONGEST} characters, or texts for {KEYS}"
        raise fail(place, expected=expected, got=str(entry)[:60], example=EXAMPLE) from error
    settings = [(setting, getattr(found, key)) for key, setting in SETTINGS.items()]
    return Prompt(
        text=found.prompt,
        settings=tuple((setting, text) for setting, text in settings if text is not None),
        name=found.name or "",
        category=found.category or "",
    )
