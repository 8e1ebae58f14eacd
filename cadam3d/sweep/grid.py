"""Grid: the list of jobs of a sweep, made from the arms of a grid and the settings in the command line.

A comparison is a union of products, such as a baseline at eight thresholds beside one CAdam, each for the
same prompts and seeds. Lists of values in a command line (``key=a,b``) are a single product and cannot
express this.
"""

import hashlib
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice, product
from typing import Any, ClassVar

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from cadam3d.core.checks import require
from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import to_json
from cadam3d.io.prompt_files import Prompt
from cadam3d.settings.compose import TEXT_KEYS, quote, slug
from cadam3d.settings.line import NOT_OF_A_RUN
from cadam3d.sweep.folder import Job
from cadam3d.sweep.prompts import PromptChoice

# Text that Hydra reads the same way with and without quotes, apart from the reserved words.
IDENTIFIER = re.compile(r"[A-Za-z_][\w./-]*", re.ASCII)
RESERVED = ("null", "true", "false", "nan", "inf")
# Keys that are shown in every table and count for the name of every folder.
ALWAYS_SHOWN = ("prompt", "seed")
# Each job starts a process, which takes seconds, and is a row of a table. With this many jobs, the starts
# alone take a day, and the table is too long to read.
MOST_JOBS = 10_000
# Lists the grids of the package, for messages about one that cannot be read.
EXAMPLE = "cadam3d sweep --help grid"


@dataclass(frozen=True)
class AxisValue:
    """One override: a key with one value."""

    key: str  # without a leading + or ~
    line: str  # as it was written for Hydra
    value: str  # as JSON
    # If this setting is a prompt of a file or a set: that prompt, and the other settings that come with it.
    prompt: Prompt | None = None
    more: tuple["AxisValue", ...] = ()

    @property
    def text(self) -> str:
        """Return the value as it is shown to readers: text has no quotes."""
        return json.loads(self.value) if self.value.startswith('"') else self.value

    @property
    def identity(self) -> str:
        """Return a text that is the same for every spelling of this setting."""
        head = self.line[: len(self.line) - len(self.line.lstrip("+~"))]
        return f"{head}{self.key}={self.value}"


# The settings of each key, of which every job takes one.
Axes = dict[str, list[AxisValue]]


@dataclass(frozen=True)
class Grid:
    """A named comparison. Every job takes one setting of each axis of ``each`` and of one arm.

    Pydantic reads it from YAML, with a value or a list of values in place of each axis.
    """

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    each: dict[str, Any] = field(default_factory=dict)  # Axes
    arms: dict[str, Any] = field(default_factory=lambda: {"": {}})  # Axes by name; "" without a grid
    prompts: str | None = None  # a file or a set; a line may choose others
    figures: list[str] | None = None  # of its report; None: all for which there are data
    paper_table: bool = False  # whether the sweep ends with the paper's table 1 of its jobs


HasSetting = Callable[[Sequence[str], str], bool]


def read_grid(node: Any) -> Grid:
    """Return the grid that plain dicts and lists describe; None describes a grid of one nameless arm.

    Raises ``UserError`` for keys that :class:`Grid` does not have and for wrong values of these.
    """
    from pydantic import TypeAdapter, ValidationError  # takes a tenth of a second to load

    try:
        grid = TypeAdapter(Grid).validate_python({} if node is None else node)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(["grid", *map(str, first["loc"])])
        raise UserError(f"{key}: {first['msg']}, got {first['input']!r}. Try: {EXAMPLE}") from error
    arms = {name: _axes(axes or {}, f"grid.arms.{name}") for name, axes in grid.arms.items()}
    return replace(grid, each=_axes(grid.each, "grid.each"), arms=arms)


def read_line(overrides: Iterable[str]) -> Axes:
    """Return the axes that a command line gives; ``a,b``, ``choice()`` and ``range()`` are several values.

    If a key comes twice, the later value counts. Raises Hydra's ``OverrideParseException``.
    """
    axes: Axes = {}
    for line in overrides:
        settings = [_setting(each) for each in _alternatives(line)]
        entry = f"~{settings[0].key}" if line.startswith("~") else settings[0].key
        axes[entry] = settings
    return axes


def prompt_axis(prompts: Iterable[Prompt]) -> list[AxisValue]:
    """Return the values of the key ``prompt``, each with the settings that come with the prompt."""
    return [
        replace(
            _setting(f"prompt={quote(each.text)}"),
            prompt=each,
            more=tuple(_setting(f"{key}={quote(value)}") for key, value in each.settings),
        )
        for each in prompts
    ]


def expand(grid: Grid, line: Axes, has_setting: HasSetting = lambda *_: True) -> list[Job]:
    """Return the jobs of all arms, each once, so that all arms of one prompt and seed come before the next.

    The line takes precedence over the grid. A setting in the line applies to every arm that has such a
    setting, because densifiers have different ones; ``has_setting(overrides of an arm, key)`` decides that. A
    setting that no arm has stays in all jobs, so that Hydra refuses it. A setting that comes with a prompt
    applies where neither the line nor the grid sets the same key and the job has such a setting. Raises
    ``UserError`` if the line makes two arms equal.
    """
    each: Axes = grid.each
    arms: dict[str, Axes] = grid.arms
    common = {key: axis for key, axis in line.items() if key not in each}
    common |= {key: line.get(key, axis) for key, axis in each.items()}
    arms = {name: {key: line.get(key, axis) for key, axis in axes.items()} for name, axes in arms.items()}
    number = sum(math.prod(map(len, [*common.values(), *axes.values()])) for axes in arms.values())
    expected = f"at most {MOST_JOBS} jobs"
    require(number <= MOST_JOBS, "sweep", expected=expected, got=number, example="cadam3d sweep --help")
    foreign = _foreign(grid, line, arms, has_setting)
    named, counted = _named(grid, line), swept_keys(grid, line)
    found: dict[frozenset[str], Job] = {}
    for shared in product(*common.values()):
        for name, axes in arms.items():
            taken = [setting for setting in shared if setting.key not in {*axes, *foreign[name]}]
            for own in product(*axes.values()):
                typed = (*taken, *own)
                brought = _brought(typed, has_setting)
                settings = (*typed, *brought)
                prompt = next((setting.prompt for setting in typed if setting.prompt), None)
                job = Job(
                    arm=name,
                    name=_folder_name(
                        name,
                        [setting for setting in typed if setting.key in named],
                        [setting for setting in settings if setting.key in counted],
                    ),
                    overrides=[setting.line for setting in settings],
                    prompt_name=prompt.name if prompt else "",
                    category=prompt.category if prompt else "",
                    brought=[setting.key for setting in brought],
                )
                other = found.setdefault(frozenset(setting.identity for setting in settings), job)
                if other.arm != name and (causes := [key for key in axes if key in line]):
                    raise UserError(
                        f"{causes[0]}: the arms {other.arm} and {name} differ in this setting, so the line "
                        f"cannot set it for both. Try: '~grid.arms.{name}'"
                    )
    return list(found.values())


def swept_keys(grid: Grid, line: Axes) -> list[str]:
    """Return the keys in which jobs may differ: the grid's, and those with several values in the line.

    Prompt and seed count too if the line gives them: another prompt is another job, not another setting of
    all jobs. Settings that come with prompts count as well, unless the line has one value for all jobs.
    """
    keys = [*grid.each, *(key for axes in grid.arms.values() for key in axes)]
    keys += [key for key, axis in line.items() if len(axis) > 1 or key in ALWAYS_SHOWN]
    brought = [each.key for axis in line.values() for setting in axis for each in setting.more]
    keys += [key for key in brought if key not in line]
    return list(dict.fromkeys(keys))


def sweep_name(grid_name: str | None, line: Axes, prompts: PromptChoice | None = None) -> str:
    """Return the name of the folder of a sweep: the name of its grid, or else a summary of the line.

    If the prompts come from a file or a set, its name stands for them. Each shard has its own folder.
    """
    suffix = "_shard-{}-of-{}".format(*prompts.shard) if prompts and prompts.shard else ""
    if grid_name:
        return f"{slug(grid_name)}{suffix}"
    # A folder that is trusted has the name that it had before.
    keys = [
        key
        for key, axis in line.items()
        if key not in NOT_OF_A_RUN and not any(setting.prompt for setting in axis)
    ]
    keys.sort(key=lambda key: (key not in TEXT_KEYS, len(line[key]) == 1, key))
    values = {key: ",".join(setting.text for setting in line[key]) for key in keys}
    words = [values[key] if key in TEXT_KEYS else f"{key}={values[key]}" for key in keys]
    parts = [setting.identity for key in keys for setting in line[key]]
    if prompts:
        words, parts = [prompts.title, *words], [prompts.identity, *parts]
    return f"{slug(*words)}_{_digest(parts)}{suffix}"


def _axes(node: Any, where: str) -> Axes:
    is_mapping = isinstance(node, dict)
    require(is_mapping, where, expected="keys with values", got=node, example=EXAMPLE)
    axes = {}
    for key, value in node.items():
        values = value if isinstance(value, list) else [value]
        require(bool(values), f"{where}.{key}", expected="a value or several", got=value, example=EXAMPLE)
        axes[key.lstrip("+")] = [_setting(f"{key}={_grammar(key, each)}") for each in values]
    return axes


def _grammar(key: str, value: Any) -> str:
    """Write a plain value so that Hydra's grammar reads the same value."""
    if key in TEXT_KEYS:
        return quote(str(value))
    if isinstance(value, str):
        is_plain = IDENTIFIER.fullmatch(value) and value.lower() not in RESERVED
        return value if is_plain else quote(value)
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{name}:{_grammar('', each)}" for name, each in value.items()) + "}"
    if isinstance(value, Sequence):
        return "[" + ",".join(_grammar("", each) for each in value) + "]"
    return "null" if value is None else str(value)


def _alternatives(line: str) -> list[str]:
    key, _, text = line.partition("=")
    expected, example = f"from 1 to {MOST_JOBS} values", f"'{key}=range(0,3)'"
    # Hydra's parser needs a minute for a list of this length.
    require(text.count(",") < MOST_JOBS, key, expected=expected, got=text, example=example)
    override = _parsed(line)
    if not override.is_sweep_override():
        return [line]
    values = []
    # An interval, a pattern and a range without an end or with the step 0 cannot be enumerated.
    with suppress(HydraException, ValueError, ArithmeticError):
        values = list(islice(override.sweep_string_iterator(), MOST_JOBS + 1))
    require(1 <= len(values) <= MOST_JOBS, key, expected=expected, got=text, example=example)
    return [f"{key}={value}" for value in values]


def _setting(line: str) -> AxisValue:
    value = _parsed(line).value()
    return AxisValue(key=line.partition("=")[0].lstrip("+~"), line=line, value=to_json(value))


def _parsed(line: str) -> Override:
    [override] = OverridesParser.create().parse_overrides([line])
    return override


def _foreign(
    grid: Grid, line: Axes, arms: Mapping[str, Axes], has_setting: HasSetting
) -> dict[str, set[str]]:
    """Return for each arm the keys of the line for which another arm has a setting and this one does not."""
    if len(arms) == 1:
        return {name: set() for name in arms}
    common = [key for key in line if key not in grid.each and not line[key][0].line.startswith(("+", "~"))]
    missing: dict[str, set[str]] = {}
    for name, axes in arms.items():
        base = [axis[0].line for key, axis in (grid.each | axes).items() if key not in common]
        missing[name] = {key for key in common if key not in axes and not has_setting(base, key)}
    in_no_arm = set.intersection(*missing.values())
    return {name: keys - in_no_arm for name, keys in missing.items()}


def _brought(settings: Sequence[AxisValue], has_setting: HasSetting) -> list[AxisValue]:
    """Return the settings that come with the prompt of a job and apply to it."""
    keys, lines = {setting.key for setting in settings}, [setting.line for setting in settings]
    brought = [each for setting in settings for each in setting.more]
    return [each for each in brought if each.key not in keys and has_setting(lines, each.key)]


def _named(grid: Grid, line: Axes) -> set[str]:
    """Return the keys that the name of a folder shows: all that may vary, even if the line narrows them."""
    varied = {key for axes in grid.arms.values() for key, axis in axes.items() if len(axis) > 1}
    varied |= {key for key, axis in grid.each.items() if len(axis) > 1}
    fixed = {key for axes in (*grid.arms.values(), grid.each) for key in axes} - varied
    # Even if a shard has a single prompt, the names of its jobs are those that they have in the whole sweep.
    several = {key for key, axis in line.items() if len(axis) > 1 or any(each.prompt for each in axis)}
    return {key for key in swept_keys(grid, line) if key not in fixed - several}


def _folder_name(arm: str, named: Sequence[AxisValue], counted: Sequence[AxisValue]) -> str:
    """Return a readable name with a digest of everything in which this job may differ from the others."""
    shown = sorted(named, key=lambda each: each.key)
    words = [each.text for each in shown if each.key in TEXT_KEYS]
    words += [f"{each.key.rpartition('.')[2]}={each.text}" for each in shown if each.key not in TEXT_KEYS]
    digest = _digest([arm, *sorted(each.identity for each in counted)])
    return "_".join([*([slug(arm)] if arm else []), slug(*words), digest])


def _digest(parts: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:8]
