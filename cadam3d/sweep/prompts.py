"""Prompts: choose the prompts of a sweep from a file or a set: a category, the first ones, or a shard."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cadam3d.core.checks import require, require_whole, unless_none
from cadam3d.io.prompt_files import Prompt, read_prompts, set_names

KEY, FILE = "prompts", "prompts.file"
SHARD, CATEGORY, FIRST = "prompts.shard", "prompts.category", "prompts.first"
SHARDS = re.compile(r"0*([1-9][0-9]{0,5})/0*([1-9][0-9]{0,5})", re.ASCII)


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
        """Return the chosen prompts: the category's, the first of these, and of these the shard.

        Shards are consecutive and differ in length by one prompt at most. Raises ``UserError`` if nothing is
        chosen.
        """
        prompts = _of_category(read_prompts(self.source), self.category)[: self.first]
        if self.shard is None:
            return prompts
        number, count = self.shard
        expected, example = f"at most {len(prompts)} shards", f"{SHARD}=1/{len(prompts)}"
        require(count <= len(prompts), SHARD, expected=expected, got=f"{number}/{count}", example=example)
        begin, end = ((number + step) * len(prompts) // count for step in (-1, 0))
        return prompts[begin:end]


def read_choice(node: Mapping[Any, Any] | None, default: str | None = None) -> PromptChoice | None:
    """Return the choice that the settings ``prompts.*`` of a sweep describe; None if it has no such prompts.

    ``default`` is the file or set of the grid. Raises ``UserError`` for wrong values.
    """
    given = {key: value for key, value in (node or {}).items() if value is not None}
    source, category, first = given.get("file", default), given.get("category"), given.get("first")
    if not given and source is None:
        return None
    expected = f"a file, or one of the sets {'|'.join(set_names())}"
    is_text = isinstance(source, str) and bool(source.strip())
    require(is_text, KEY, expected=expected, got=source, example=f"{KEY}={set_names()[0]}")
    unless_none(require_whole, FIRST, first, low=1)
    category = None if category is None else str(category).strip()
    return PromptChoice(source=source, category=category, first=first, shard=_shard(given.get("shard")))


def _of_category(prompts: tuple[Prompt, ...], category: str | None) -> tuple[Prompt, ...]:
    """Return the prompts of a category, in upper or lower case; None means all prompts."""
    if category is None:
        return prompts
    chosen = tuple(each for each in prompts if category and each.category.casefold() == category.casefold())
    known = dict.fromkeys(each.category for each in prompts if each.category)
    expected = f"one of {'|'.join(known)}"
    require(bool(chosen), CATEGORY, expected=expected, got=category, example=f"{CATEGORY}=null")
    return chosen


def _shard(value: Any) -> tuple[int, int] | None:
    if value is None:
        return None
    match = SHARDS.fullmatch(value) if isinstance(value, str) else None
    number, count = map(int, match.groups()) if match else (1, 0)
    expected = "i/n, with i from 1 to n"
    require(number <= count, SHARD, expected=expected, got=value, example=f"{SHARD}=1/4")
    return number, count
