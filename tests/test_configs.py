"""Configuration files: each has exactly the keys of its class, composes, and builds a component that runs."""

import dataclasses
import gc
import inspect
import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml
from omegaconf import DictConfig, OmegaConf

from cadam3d import cli, regularizer
from cadam3d.build import component, components
from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import read_json, read_jsonl
from cadam3d.io.prompt_files import read_prompts
from cadam3d.launch import read_line
from cadam3d.settings.compose import compose, flatten, quote
from cadam3d.settings.line import read_flags
from cadam3d.settings.options import config_dir
from cadam3d.sweep import plan
from cadam3d.sweep.plan import read_sweep

CONFIGS = config_dir()
SEVERAL = ("exporter", "callback", "metric")  # groups with several choices
NO_COMPONENTS = ("hydra", "grid", "launcher", "experiment", "noise", "vram", "for")
GROUPS = {
    path.name: sorted(file.stem for file in path.glob("*.yaml"))
    for path in sorted(CONFIGS.iterdir())
    if path.is_dir() and path.name not in NO_COMPONENTS
}
FILES = [CONFIGS / group / f"{name}.yaml" for group, names in GROUPS.items() for name in names]
GRIDS = sorted(path.stem for path in (CONFIGS / "grid").glob("*.yaml"))
EXPERIMENTS = sorted(
    str(path.relative_to(CONFIGS / "experiment").with_suffix(""))
    for path in (CONFIGS / "experiment").rglob("*.yaml")
)
PROMPT = "prompt=a red cube"
NO_FLAGS, _ = read_flags([])


@pytest.fixture(scope="module", autouse=True)
def large_heap():
    """Keep the garbage collector from scanning all of torch repeatedly while Hydra composes."""
    gc.freeze()
    yield
    gc.unfreeze()


def name_of(path: Path) -> str:
    return str(path.relative_to(CONFIGS).with_suffix(""))


def read(path: Path) -> Any:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def nested_groups(path: Path) -> set[str]:
    """Return the keys that a group inside this group sets, such as ``fallback`` of an initializer."""
    return {name for name in chosen_groups(path) if not name.startswith("override ")}


def chosen_groups(path: Path) -> dict[str, str]:
    """Return the option of each group in the list of defaults of a file."""
    entries = read(path).get("defaults", [])
    return {name: option for entry in entries if isinstance(entry, dict) for name, option in entry.items()}


def with_base(path: Path) -> dict[str, Any]:
    """Return the keys of a file and of the files that it builds on."""
    content = read(path)
    # An entry with @ makes another node, below or beside this one.
    entries = [entry for entry in content.pop("defaults", []) if isinstance(entry, str)]
    bases = [entry for entry in entries if entry != "_self_" and "@" not in entry]
    return {key: value for base in bases for key, value in with_base(path.with_stem(base)).items()} | content


NESTED = sorted((CONFIGS / "initializer").glob("*/*.yaml"))  # of groups inside a group
# What an exporter shares with others is no option.
VARIANTS = [
    path
    for path in FILES
    if "defaults" in read(path) and not nested_groups(path) and "@_here_" not in str(read(path)["defaults"])
]
# Options that also choose options of other groups and set values outside of their own node.
GLOBAL = [path for path in FILES if path.read_text(encoding="utf-8").startswith("# @package _global_\n")]


@cache
def round_of_choices(number: int) -> DictConfig:
    """Compose option ``number`` of every group at once, so that all options take a few compositions only."""
    chosen = [
        f"{group}={names[number % len(names)]}" for group, names in GROUPS.items() if group not in SEVERAL
    ]
    chosen += [f"{group}=[{','.join(GROUPS[group])}]" for group in SEVERAL]
    return compose([PROMPT, *chosen])


@cache
def composed(path: Path) -> DictConfig:
    """Return the composed node of an option."""
    group, name = path.parent.name, path.stem
    try:
        cfg = round_of_choices(GROUPS[group].index(name))
    except Exception:
        # Another option of the same round may be broken, so this one is composed without the others.
        cfg = compose([PROMPT, f"{group}=[{name}]" if group in SEVERAL else f"{group}={name}"])
    return cfg[group][name] if group in SEVERAL else cfg[group]


def nodes(value: Any) -> Iterator[dict[str, Any]]:
    """Yield every node that names a class, the outermost first."""
    if isinstance(value, dict):
        if "_target_" in value:
            yield value
        value = list(value.values())
    for item in value if isinstance(value, list) else []:
        yield from nodes(item)


def class_of(node: dict[str, Any]) -> type:
    module, _, name = node["_target_"].rpartition(".")
    return getattr(import_module(module), name)


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_a_node_has_exactly_the_keys_of_its_class(path):
    for node in nodes(OmegaConf.to_container(composed(path), resolve=False)):
        keys = set(node) - {"_target_"}
        fields = {field.name: field for field in dataclasses.fields(class_of(node)) if field.init}
        required = {
            name
            for name, field in fields.items()
            if field.default is field.default_factory is dataclasses.MISSING
        }
        assert required <= keys <= set(fields), node["_target_"]


@pytest.mark.parametrize("path", VARIANTS, ids=name_of)
def test_a_variant_changes_values_of_what_it_builds_on(path):
    changes = read(path)
    base, *_, itself = changes.pop("defaults")
    group = path.parent.name
    if path in GLOBAL:
        changes = changes[group]
        base = base.removesuffix(f"@{group}")
    original = with_base(path.with_stem(base))
    assert itself == "_self_"
    # A variant with another class may have further keys.
    assert set(changes) < set(original) or "_target_" in changes
    assert not [key for key, value in changes.items() if key in original and value == original[key]]


def test_the_momentum_ablation_needs_its_threshold():
    node = composed(CONFIGS / "densifier" / "cadam_momentum.yaml")
    with pytest.raises(UserError, match=r"^densifier\.tau_m: expected a number"):
        component(node, key="densifier")
    node.tau_m = 0.001
    assert component(node).limits_drift


def test_a_component_declares_no_default_values():
    """Numbers are only in the YAML files. Schedules and paths inside a component may have defaults."""
    contents = map(composed, FILES)
    nodes = [node for each in contents for node in ([each] if "_target_" in each else each.values())]
    settings = [(node, field) for node in nodes for field in dataclasses.fields(class_of(node)) if field.init]
    assert not [(node, field) for node, field in settings if field.default is not dataclasses.MISSING]


@pytest.mark.parametrize("path", GLOBAL, ids=name_of)
def test_an_option_that_chooses_others_sets_nothing_inside_their_groups(path):
    """A value there would remain if the command line or a recipe chose another option of that group."""
    choices, changes = chosen_groups(path), set(read(path)) - {"defaults", path.parent.name}
    assert all(name.startswith("override /") for name in choices)
    assert not changes & set(GROUPS)
    cfg = compose([PROMPT, f"{path.parent.name}={path.stem}"], flags=NO_FLAGS)
    chosen = cfg.hydra.runtime.choices
    assert all(chosen[name.removeprefix("override /")] == option for name, option in choices.items())
    # Whatever else is typed, or chosen by a recipe, wins.
    other = compose(
        [PROMPT, f"{path.parent.name}={path.stem}", "experiment=mvdream", "camera=sphere", "views=8"],
        flags=NO_FLAGS,
    )
    chosen = other.hydra.runtime.choices
    assert (chosen.prior, chosen.camera, chosen.guidance) == (path.stem, "sphere", "sds_mvdream")
    assert (other.views, other.steps, other.guidance.scale) == (8, 1200, 50.0)
    assert "relative_distance" not in other.camera


def test_an_option_of_a_group_with_several_choices_has_its_own_node():
    for path in [path for path in FILES if path not in GLOBAL]:
        header = path.read_text(encoding="utf-8").splitlines()[0]
        wanted = f"# @package {path.parent.name}.{path.stem}"
        is_one_of_several = path.parent.name in (*SEVERAL, "regularizer") and path.stem != "none"
        assert header == wanted if is_one_of_several else not header.startswith("# @package"), path


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_every_option_composes_and_builds(path):
    node = composed(path)
    # Some options need a value that only the user can give.
    if path.stem == "cadam_momentum":
        return
    if "???" in path.read_text(encoding="utf-8"):
        with pytest.raises(UserError, match=r"(?i)missing"):
            component(node)
    else:
        assert (component(node) if "_target_" in node else components(node, object, "part")) is not None


@pytest.mark.parametrize("path", NESTED, ids=name_of)
def test_every_option_of_a_nested_group_composes_and_builds(path):
    outer, inner = path.parent.parent.name, path.parent.name
    [owner, *_] = [file for file in FILES if file.parent.name == outer and inner in nested_groups(file)]
    cfg = compose([PROMPT, f"{outer}={owner.stem}", f"{outer}/{inner}={path.stem}"])
    assert "_target_" in cfg[outer][inner]
    assert component(cfg[outer]) is not None


def test_a_fallback_initializer_has_the_values_of_the_initializer_itself():
    for path in sorted((CONFIGS / "initializer/fallback").glob("*.yaml")):
        cfg = compose([PROMPT, "initializer=shap_e", f"initializer/fallback={path.stem}"])
        assert cfg.initializer.fallback == composed(CONFIGS / f"initializer/{path.stem}.yaml")
        assert component(cfg.initializer).fallback is not None


def test_every_regularizer_has_its_own_file_and_several_can_be_chosen():
    kinds = [kind for _, kind in inspect.getmembers(regularizer, inspect.isclass)]
    kinds = [kind for kind in kinds if issubclass(kind, regularizer.Regularizer)]
    classes = {kind.__name__ for kind in kinds if not inspect.isabstract(kind)}
    names = sorted({path.stem for path in FILES if path.parent.name == "regularizer"} - {"none"})
    cfg = compose([PROMPT, f"regularizer=[{','.join(names)}]"]).regularizer
    assert sorted(cfg) == names
    assert {type(each).__name__ for each in components(cfg, object, "regularizer").values()} == classes


def test_the_groups_of_train_are_the_packages_of_components():
    chosen = [
        next(iter(entry)) for entry in read(CONFIGS / "train.yaml")["defaults"] if isinstance(entry, dict)
    ]
    assert set(GROUPS) == set(chosen) - set(NO_COMPONENTS)


def choice_of(override: str) -> str:
    """Return the part of an override on which composing depends: a key, or a choice with its value."""
    key = override.partition("=")[0]
    return key if "." in key else override


@cache
def line_of_jobs(command: str, overrides: tuple[str, ...]) -> DictConfig:
    return ORIGINAL_COMPOSE(overrides, command, NO_FLAGS)


ORIGINAL_COMPOSE = plan.compose


@pytest.mark.parametrize("grid", GRIDS)
def test_every_arm_of_a_grid_composes(grid, monkeypatch):
    """Of the prompts, seeds and noises that all arms share, and of a set, only the first is composed.

    The number of jobs that the file claims is compared with the product of all.
    """
    monkeypatch.setattr(plan, "compose", lambda line, command, _: line_of_jobs(command, tuple(line)).copy())
    text = (CONFIGS / "grid" / f"{grid}.yaml").read_text(encoding="utf-8")
    shared = {
        k: v for k, v in yaml.safe_load(text).get("each", {}).items() if isinstance(v, list) and len(v) > 1
    }
    axes = {key: values for key, values in shared.items() if key in ("seed", "noise", "prompt")}
    firsts = {key: values[0] for key, values in axes.items()}
    line = [
        f"grid={grid}",
        *(f"{key}={quote(first) if isinstance(first, str) else first}" for key, first in firsts.items()),
    ]
    named = yaml.safe_load(text).get("prompts")
    line += [] if "prompt" in axes else ["prompts.first=1" if named else PROMPT]
    of_set = len(read_prompts(named)) if named else 1
    sweep = read_sweep(read_line("sweep", line))
    assert len(sweep.plan.jobs) > 1
    claimed = re.search(r": ([\d,]+) jobs", text)
    counted = len(sweep.plan.jobs) * math.prod(len(values) for values in axes.values()) * of_set
    assert claimed is None or int(claimed.group(1).replace(",", "")) == counted
    cfg = OmegaConf.to_container(compose(sweep.plan.jobs[-1].overrides), resolve=True)
    # A setting that names another node, such as prior.prompting, keeps that node as its value in a sweep.
    assert dict(flatten(sweep.composed[-1].values)) == dict(flatten(cfg))


@pytest.mark.parametrize("path", sorted((CONFIGS / "launcher").glob("*.yaml")), ids=lambda path: path.stem)
def test_a_launcher_configures_a_launcher_of_hydra(path):
    """The plugins need not be installed for this. test_sweeps.py runs a launcher with an installed plugin."""
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# @package _global_\n")
    assert "pip install" in text
    content = yaml.safe_load(text)
    assert [*content["defaults"][0]] == ["override /hydra/launcher"]
    used = set(re.findall(r"\$\{launcher\.(\w+)\}", text))
    assert used | {"threads"} == content["launcher"].keys()


# Experiments with a pretrained prior, which test_recipes.py trains.
RECIPES = {name for name in EXPERIMENTS if "/prior:" in (CONFIGS / "experiment" / f"{name}.yaml").read_text()}
RECIPES |= {name for name in EXPERIMENTS if name.partition("_")[0] in RECIPES}
RUN_ELSEWHERE = RECIPES | {"smoke"}  # test_end_to_end.py trains it


@pytest.mark.parametrize("experiment", sorted(set(EXPERIMENTS) - RUN_ELSEWHERE))
def test_every_experiment_runs_two_steps_on_the_tiny_prior(experiment, tmp_path, monkeypatch):
    raw = read(CONFIGS / "experiment" / f"{experiment}.yaml")
    lines = [PROMPT, f"experiment={experiment}", "prior=tiny", "rasterizer=auto", "steps=2"]
    lines += ["camera.size=16", "initializer.count=20", f"hydra.run.dir={tmp_path}"]
    lines += [line for line in ("exporter=[ply]", "metric=[size]") if line.partition("=")[0] not in raw]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["cadam3d", "train", *lines])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    assert read_json(tmp_path / "summary.json")["outcome"] == "finished"
    assert read_jsonl(tmp_path / "metrics.jsonl")
    assert (tmp_path / "asset.ply").is_file()


# --- building ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Faulty:
    whole: int

    def __post_init__(self) -> None:
        assert 1 / self.whole


@dataclass(frozen=True, kw_only=True)
class Holder:
    numbers: Sequence[int]
    deep: Mapping[str, Any]


def node(target: str, **values: Any):
    return OmegaConf.create({"part": {"_target_": target, **values}}).part


def test_the_error_of_a_constructor_names_the_place_of_its_node():
    with pytest.raises(UserError, match=r"^part.steps: expected a whole number >= 1, got 0."):
        component(node("cadam3d.core.schedule.Linear", start=1.0, end=0.0, steps=0), key="part")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"value": 1.0, "speed": 2}, r"part\.speed: no such setting\."),
        ({"valu": 1.0}, r"part\.valu: no such setting\. Did you mean part\.value\? Try: part\.value=1\.0"),
        ({}, "part: missing a required argument: 'value'"),
    ],
)
def test_wrong_keys_are_named(values, message):
    with pytest.raises(UserError, match=message):
        component(node("cadam3d.core.schedule.Constant", **values), key="part")


@pytest.mark.parametrize("target", ["cadam3d.nowhere.Thing", "cadam3d.core.schedule.Nothing"])
def test_a_class_that_cannot_be_loaded_is_named(target):
    with pytest.raises(UserError, match=r"part\._target_: .* cannot be loaded"):
        component(node(target), key="part")


def test_a_value_that_is_still_missing_is_named():
    with pytest.raises(UserError, match=r"part\.value: "):
        component(node("cadam3d.core.schedule.Constant", value="???"))


def test_a_bug_in_a_constructor_keeps_its_exception():
    with pytest.raises(ZeroDivisionError):
        component(node(f"{__name__}.Faulty", whole=0))


def test_lists_and_inner_nodes_become_plain_objects():
    inner = {"_target_": "cadam3d.core.schedule.Constant", "value": 2.0}
    built = component(node(f"{__name__}.Holder", numbers=[1, 2], deep={"schedule": inner}))
    assert type(built.numbers) is list
    assert type(built.deep) is dict
    assert built.deep["schedule"](0) == 2.0


def test_composing_inside_a_running_command_leaves_it_alone():
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    with initialize_config_dir(str(CONFIGS.resolve()), version_base="1.3"):
        outer = GlobalHydra.instance().hydra
        compose([PROMPT])
        assert GlobalHydra.instance().hydra is outer


@pytest.mark.parametrize(
    "text", ["a ${oc.env:HOME}", r"a \${prompt}", r"a \\${steps} b", "${", "$5", "a\\", "${a} '${b}'"]
)
def test_a_prompt_reaches_a_component_as_it_is_whatever_it_looks_like(text):
    cfg = compose([f"prompt={quote(text)}", "exporter=[html]"])
    assert cfg.prompt == text
    assert component(cfg.exporter.html).title == text
