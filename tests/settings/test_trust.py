"""A folder from a stranger is data: no setting, link or cache in it makes a command run its code."""

import json
import os
import shutil
import sys
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from omegaconf import DictConfig, OmegaConf

from cadam3d.build import component
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io.ply import write_ply
from cadam3d.prior.base import DiffusionPrior
from cadam3d.settings.compose import compose, flatten
from cadam3d.settings.line import key_of, read_flags, resumed
from cadam3d.settings.options import config_dir
from cadam3d.settings.trust import MACHINERY, judge_overrides, read_components, require_contained

CONFIGS = config_dir()
EXPERIMENTS = sorted(path.stem for path in (CONFIGS / "experiment").glob("*.yaml"))
RETRY = "cadam3d train resume=run trust=true"
PAYLOAD = "planted.run"
# The whole of every group of which several can be chosen.
EVERYTHING = [
    f"{group}=[{','.join(sorted(path.stem for path in (CONFIGS / group).glob('*.yaml')))}]"
    for group in ("exporter", "callback", "metric")
]


@pytest.fixture
def marker(tmp_path, monkeypatch) -> Path:
    """Put a module on the path whose import and whose call leave a file, and return the path of the file."""
    place = tmp_path / "importable"
    place.mkdir()
    marker = tmp_path / "marker"
    code = f"open({str(marker)!r}, 'w').close()"
    call = f"def run(*args, **kwargs):\n    {code}\n    raise SystemExit(3)"
    own = "class Own(Callback):\n    def __init__(self):\n        run()"
    text = "\n".join([code, call, "from cadam3d.callback.base import Callback", own])
    (place / "planted.py").write_text(f"{text}\n", encoding="utf-8")
    monkeypatch.syspath_prepend(str(place))
    monkeypatch.delitem(sys.modules, "planted", raising=False)
    return marker


@pytest.fixture
def run_folder(tmp_path) -> Path:
    """Return the folder of an honest run."""
    folder = tmp_path / "run"
    (folder / ".hydra").mkdir(parents=True)
    lines = [
        "prompt='a red cube'",
        "rasterizer=reference",
        "exporter=[]",
        "callback=[]",
        "metric=[]",
        "steps=1",
    ]
    (folder / ".hydra/overrides.yaml").write_text(yaml.safe_dump(lines), encoding="utf-8")
    return folder


def add_override(folder: Path, *lines: str) -> None:
    path = folder / ".hydra/overrides.yaml"
    path.write_text(yaml.safe_dump([*yaml.safe_load(path.read_text()), *lines]), encoding="utf-8")


def judged(*lines: str) -> list[str]:
    return judge_overrides(lines, Path("overrides.yaml"), (), [CONFIGS], RETRY)


def content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# --- overrides --------------------------------------------------------------------------------------------

HOSTILE = [
    # An unknown target, or one that is not exactly as a YAML file names it.
    "densifier._target_=planted.run",
    "camera._target_=builtins.eval",
    "camera._target_=''",
    "camera._target_=' cadam3d.camera.orbit.Orbit'",
    "camera._target_=cadam3d.camera.orbit",
    "camera._target_=cadam3d.camera.orbit.math.exp",
    "camera._target_='cadam3d.camera.\u1d52rbit.Orbit'",
    "camera._target_=null",
    "camera._target_=3",
    "camera._target_=[]",
    "camera._target_={_target_: x}",
    "camera._target_=${prompt}",
    "camera.size={_target_: planted.run}",
    "camera.size=[[{_target_: planted.run}]]",
    "+metric.x={a: {b: {_target_: planted.run}}}",
    "+callback.x={_target_: planted.run}",
    "hydra.mode=MULTIRUN",
    "+hydra.callbacks.x={_target_: planted.run}",
    "++hydra.callbacks={x: {_target_: planted.run}}",
    "hydra.searchpath=[file:///tmp/planted]",
    "+hydra.job.env_set.CXX=planted",
    "hydra.job.env_set={CXX: planted}",
    "hydra.job_logging.root.handlers=[file]",
    "hydra.job_logging.handlers.file.filename=/tmp/planted",
    "hydra.output_subdir=../../planted",
    "hydra.run.dir=/tmp/planted",
    "hydra.launcher._target_=planted.run",
    "hydra/launcher=joblib",
    "+hydra/job_logging=default",
    "hydra@x=default",
    "hydra=default",
    "+hydra={mode: MULTIRUN}",
    "~hydra",
    "~hydra.job_logging",
    "~hydra/launcher",
    "$hydra=x",
    "hydra$.mode=x",
    " hydra.mode=MULTIRUN",
    "@hydra=default",
    "+_global_={hydra: {mode: MULTIRUN}}",
    "+defaults=[{hydra: planted}]",
    "camera@hydra=orbit",
    "camera@_global_=orbit",
    "+camera@hydra.job=orbit",
    "/camera=orbit",
    "experiment=../../../../tmp/planted",
    "+experiment=/tmp/planted",
    "experiment=[smoke,../planted]",
    "experiment=${oc.env:PLANTED}",
    "camera={_target_: planted.run}",
    "+camera={_target_: planted.run}",
    "rasterizer={cache_dir: /tmp/planted}",
    "++rasterizer={cache_dir: /tmp/planted}",
    "initializer/fallback=../../planted",
    "camera/../hydra=x",
    "densifier._args_=[planted]",
    "+densifier._partial_=true",
    "++densifier._recursive_=false",
    "+densifier._convert_=none",
    "+callback.x={a: [{_args_: [planted]}]}",
    "steps=1,2",
    "seed=range(3)",
    "seed=choice(1,2)",
    "camera.size=glob(*)",
    "seed=interval(0,1)",
    "prompt=${oc.env:HOME}",
    "prompt='a ${oc.decode:planted}'",
    "prompt='${cadam3d.slug:${oc.env:HOME}}'",
    r"prompt='a \\${oc.env:HOME}'",
    r"prompt='\${a}${oc.env:HOME}'",
    "prompt='${${a}:b}'",
    "prompt='${sl${a}ug:b}'",
    "prompt='${hydra:runtime.cwd}'",
    "prompt='${now:%Y}'",
    "camera.distance=[1,'${oc.create:planted}']",
    "+camera.x={y: '${oc.select:a}'}",
    "++densifier.tau_Q='${cadam3d.span:0.43,${refine.start},${refine.end},${steps}}'",
    "prompt='${cadam3d.slug:a}'",
    "prompt=${hydra.runtime.cwd}",
    "mystery=3",
    "+mystery.key=3",
    "",
    "steps",
    "=3",
    "steps=[" + "[" * 3000,
]


@pytest.mark.parametrize("line", HOSTILE)
def test_an_override_that_is_more_than_a_setting_of_training_is_refused(line):
    with pytest.raises(UserError, match=r"overrides\.yaml: .* Try: cadam3d train resume=run trust=true"):
        judged("steps=3", line)


def test_honest_overrides_are_kept_as_they_are():
    lines = [
        "prompt='a corgi, front view'",
        r"prompt='literally \${oc.env:HOME}'",
        "negative_prompt=",
        "+experiment=smoke",
        "experiment=mine/second.try",
        "exporter=[ply,turntable]",
        "regularizer=[]",
        "camera=null",
        "initializer/fallback=ball",
        "initializer.fallback=null",
        "refine.end=${steps}",
        "camera._target_=cadam3d.camera.orbit.Orbit",
        "~callback.progress",
        "densifier.tau_Q={_target_: cadam3d.core.schedule.Linear, start: 0.5, end: 0.9, steps: 300}",
        "camera.distance=[3.0,4.0]",
    ]
    assert judged(*lines) == lines


def test_a_recipe_can_be_resumed_and_measured(tmp_path):
    words = [*(f"experiment={each}" for each in EXPERIMENTS), "noise=weak", *EVERYTHING]
    assert judged(*words) == words
    cfg = compose(["prompt=a", "experiment=luciddreamer", *EVERYTHING])
    assert components_of(OmegaConf.to_container(cfg, resolve=True), tmp_path).prior._target_


def test_accepted_overrides_do_not_change_hydras_own_settings():
    words = ["prompt=b", "experiment=smoke", "noise=weak", "exporter=[ply]", "~callback.progress"]
    nodes = [compose(lines, flags=read_flags([])[0]).hydra for lines in (["prompt=a"], judged(*words))]
    ours, theirs = (dict(flatten(OmegaConf.to_container(node))) for node in nodes)
    changed = {key for key in ours.keys() | theirs.keys() if ours.get(key) != theirs.get(key)}
    assert {key for key in changed if not key.startswith(("overrides.", "runtime.choices."))} <= {
        "job.override_dirname"
    }


def test_no_option_that_a_run_can_choose_sets_anything_of_hydra():
    groups = [path for path in CONFIGS.iterdir() if path.is_dir() and path.name not in MACHINERY]
    for path in [path for group in groups for path in group.rglob("*.yaml")]:
        raw = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert "hydra" not in raw, path
        assert not any("hydra" in str(entry) for entry in raw.get("defaults", ())), path


def test_a_folder_of_this_line_adds_its_components_of_groups_and_nothing_else(tmp_path):
    for name, target in {"exporter/xyz": "mine.Xyz", "run/config": "mine.Evil"}.items():
        path = tmp_path / f"{name}.yaml"
        path.parent.mkdir()
        path.write_text(f"_target_: {target}\n")
    for target in ("mine.Xyz", "mine.Evil"):
        with pytest.raises(UserError):
            judged(f"+exporter.x._target_={target}")
    folders = [tmp_path, CONFIGS]
    path = Path("overrides.yaml")
    assert judge_overrides(["+exporter.x._target_=mine.Xyz"], path, (), folders, RETRY)
    with pytest.raises(UserError):
        judge_overrides(["+exporter.x._target_=mine.Evil"], path, (), folders, RETRY)


def test_a_cache_of_the_run_is_ignored_with_a_note_unless_this_line_names_it(run_folder, capsys):
    add_override(run_folder, "rasterizer=cpu", "rasterizer.cache_dir=/planted", "+prior.cache_dir=/planted")
    lines = resumed([f"resume='{run_folder}'"], is_sweep=False)
    assert not [line for line in lines if "cache_dir" in line]
    err = capsys.readouterr().err
    assert "rasterizer.cache_dir" in err
    assert "prior.cache_dir" in err
    own = "rasterizer.cache_dir=/mine"
    assert own in resumed([f"resume='{run_folder}'", own], is_sweep=False)
    assert "rasterizer" not in capsys.readouterr().err


def test_a_job_that_resumes_with_its_own_overrides_gets_the_same_configuration(run_folder):
    own = yaml.safe_load((run_folder / ".hydra/overrides.yaml").read_text())
    extra = ["~callback.progress", "+densifier.x=3", "++camera.size=8"]
    add_override(run_folder, *extra)
    word = f"resume='{run_folder}'"
    assert resumed([word, *own, *extra], is_sweep=False) == resumed([word], is_sweep=False)
    cached = [*own, *extra, "rasterizer.cache_dir=/mine"]
    assert "rasterizer.cache_dir=/mine" in resumed([word, *cached], is_sweep=False)


def test_trust_itself_is_never_taken_from_a_run(run_folder):
    add_override(run_folder, "trust=true", "+trust=true", "steps=2")
    lines = resumed([f"resume='{run_folder}'"], is_sweep=False)
    assert "steps=2" in lines
    assert not [line for line in lines if key_of(line) == "trust"]


@pytest.mark.parametrize("text", ["a: 1", "steps=3", "[{steps: 3}]", "- !!python/name:os.system"])
def test_a_file_that_is_not_a_list_of_overrides_is_one_message(text, run_folder):
    (run_folder / ".hydra/overrides.yaml").write_text(text)
    with pytest.raises(UserError, match=r"overrides\.yaml: expected"):
        resumed([f"resume='{run_folder}'"], is_sweep=False)


# --- config.yaml ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def composed() -> DictConfig:
    """Return the settings of a run. Tests must not change them."""
    return compose(["prompt=a red cube", "rasterizer=cpu"])


@pytest.fixture
def config(composed) -> Any:
    """Return the plain settings of a run, which a test may change."""
    plain = OmegaConf.to_container(composed, resolve=True)
    assert isinstance(plain, dict)
    return plain


def components_of(plain: object, folder: Path, **options: Any) -> DictConfig:
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(plain), encoding="utf-8")
    options = {"is_trusted": False, "retry": "cadam3d eval run=run trust=true", **options}
    return read_components(path, ("prior", "rasterizer"), [CONFIGS], **options)


def test_a_payload_in_a_component_that_is_built_is_refused(config, tmp_path):
    components_of(config, tmp_path)
    places = [
        key for key, _ in flatten({name: config[name] for name in ("prior", "rasterizer")}, with_nodes=True)
    ]
    payloads = ({"_target_": PAYLOAD}, [{"_target_": PAYLOAD}], {"a": [{"_target_": PAYLOAD}]})
    for key, payload in zip(places, cycle(payloads), strict=False):
        cfg = OmegaConf.create(config)
        OmegaConf.update(cfg, key, payload, merge=False, force_add=True)
        with pytest.raises(UserError, match=r"config\.yaml: .*Try: "):
            components_of(OmegaConf.to_container(cfg), tmp_path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("_args_", ["x"]), ("_partial_", True), ("_recursive_", False), ("_convert_", "none")),
        *((3, 4), (None, 1), ("an_old_key", 1), ("${oc.env:HOME}", 1)),
        # Known classes in wrong places, and what is no class.
        *(("_target_", "cadam3d.exporter.ply.PlyExporter"), ("_target_", "cadam3d.core.schedule.Linear")),
        *(("_target_", "cadam3d.core.schedule.math.exp"), ("_target_", "cadam3d.prior.path")),
    ],
)
def test_what_a_component_does_not_have_is_refused_before_it_is_built(key, value, config, tmp_path):
    for node in (config["prior"], config["prior"]["noise_path"]):
        before = dict(node)
        node[key] = value
        with pytest.raises(UserError):
            component(components_of(config, tmp_path).prior, DiffusionPrior)
        node.clear()
        node.update(before)


@pytest.mark.parametrize(
    "node", [None, 3, "x", [], {}, {"_target_": None}, [{"_target_": PAYLOAD}], {"a": 1}]
)
def test_a_run_without_its_components_is_one_message(node, config, tmp_path):
    for key in ("prior", "rasterizer"):
        with pytest.raises(UserError, match=r"config\.yaml: .*Try: "):
            components_of({**config, key: node}, tmp_path)


@pytest.mark.parametrize("plain", [None, [], 3, {}, {"prompt": 3}, {"prompt": None}])
def test_a_file_that_is_not_the_configuration_of_a_run_is_one_message(plain, tmp_path):
    with pytest.raises(UserError, match=r"config\.yaml: expected the settings of a run.* Try: "):
        components_of(plain, tmp_path)


@pytest.mark.parametrize(
    "value",
    [
        *("!!pairs [a: {_target_: planted.run}]", "!!omap [a: {_target_: planted.run}]", "!!set {a}"),
        *("!!binary aGVsbG8=", "!!timestamp 2001-01-01", "!!python/object/apply:planted.run []"),
        *("!!python/name:planted.run", "!mine x", "[{_target_: planted.run}]", "*anchor"),
    ],
)
def test_only_plain_yaml_is_read(value, config, tmp_path, marker):
    components_of(config, tmp_path)
    path = tmp_path / "config.yaml"
    key = "model_error:"
    lines = [f"  {key} {value}" if key in line else line for line in path.read_text().splitlines()]
    path.write_text("\n".join(lines))
    with pytest.raises(UserError, match=r"config\.yaml: expected"):
        read_components(path, ("prior", "rasterizer"), [CONFIGS], is_trusted=False, retry=RETRY)
    assert not marker.exists()


def test_text_that_looks_like_an_interpolation_stays_text(config, tmp_path):
    config["prompt"] = "a ${oc.env:HOME}"
    assert components_of(config, tmp_path).prompt == "a ${oc.env:HOME}"


def test_the_cache_of_a_configuration_is_ignored_with_a_note(config, tmp_path, capsys):
    config["rasterizer"]["cache_dir"] = "/planted"
    assert components_of(config, tmp_path).rasterizer.cache_dir is None
    assert "rasterizer.cache_dir" in capsys.readouterr().err
    assert components_of(config, tmp_path, is_trusted=True).rasterizer.cache_dir == "/planted"


# --- models and accounts ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "line",
    [
        "prior.ids=[evil/model]",
        "prior.ids=[stable-diffusion-v1-5/stable-diffusion-v1-5,evil/model]",
        "prior.ids=['${prompt}']",
        "+prior={ids: [evil/model]}",
        "prior.revision=refs/pr/5",
        "prior.tokenizer=evil/words",
        "initializer.fallback={_target_: cadam3d.initializer.shap_e.ShapE, ids: [evil/model]}",
        "metric.clip_score.model=evil/clip@main",
        "protocol.models.vqa=evil/vqa",
    ],
)
def test_a_model_that_no_yaml_file_names_is_not_downloaded_for_a_run(line, capsys):
    with pytest.raises(UserError) as caught:
        judged(line)
    assert "Try: " in str(caught.value)


def test_models_of_the_package_on_this_disk_or_in_the_line_are_accepted(tmp_path):
    accepted = [
        "prior.ids=[stable-diffusion-v1-5/stable-diffusion-v1-5]",
        "initializer.ids=[openai/shap-e]",
        f"metric.clip_score.model={tmp_path}",
        "prior.revision=null",
        "metric.hps.model=null",
    ]
    assert judged(*accepted) == accepted
    # The line sets the same key, so its own value is used.
    judge_overrides(["prior.ids=[evil/model]"], Path("x"), ("prior.ids",), [CONFIGS], RETRY)


def test_a_configuration_cannot_name_a_model_either(config, tmp_path):
    config["prior"]["ids"] = ["evil/model"]
    with pytest.raises(UserError, match="got 'prior: evil/model'"):
        components_of(config, tmp_path)
    components_of(config, tmp_path, is_trusted=True)


def test_a_run_does_not_choose_the_account_that_it_is_sent_to(capsys):
    assert judged("callback=[wandb]", "callback.wandb.entity=evil") == ["callback=[wandb]"]
    assert "Note: callback.wandb.entity in overrides.yaml is ignored" in capsys.readouterr().err
    with pytest.raises(UserError):
        judged("+callback.own={_target_: cadam3d.callback.wandb.Wandb, entity: evil}")


# --- links ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", ["train.log", ".lock", "checkpoints", ".hydra/x.yaml", "a/b/c/eval.json"])
@pytest.mark.parametrize("target", ["outside/file", "outside/missing", "outside"])
def test_a_link_that_leads_out_of_a_folder_is_refused_at_any_depth(place, target, run_folder, tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside/file").touch()
    require_contained(run_folder, RETRY)
    link = run_folder / place
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(tmp_path / target)
    with pytest.raises(UserError, match="got a link to"):
        require_contained(run_folder, RETRY)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no such pipes")
def test_a_pipe_for_which_a_command_would_wait_is_refused(run_folder, type_line):
    os.mkfifo(run_folder / ".hydra/config.yaml")
    result = type_line("train", f"resume={run_folder}")
    assert "got a named pipe. Try: rm " in result.err


def test_a_link_that_stays_in_its_folder_is_accepted(run_folder, tmp_path):
    (run_folder / "newest.log").symlink_to("train.log")
    (run_folder / "here").symlink_to(run_folder)
    (tmp_path / "latest").symlink_to(run_folder)
    require_contained(tmp_path / "latest", RETRY)


def test_a_link_through_another_link_is_followed_to_its_end(run_folder, tmp_path):
    (run_folder / "first").symlink_to("second")
    (run_folder / "second").symlink_to(tmp_path)
    with pytest.raises(UserError, match="got a link to"):
        require_contained(run_folder, RETRY)


@pytest.mark.parametrize("name", ["train.log", ".lock", ".hydra/hydra.yaml", "metrics.jsonl", "a/b/x"])
def test_a_hard_link_to_a_file_of_the_user_is_refused_and_the_file_stays(
    name, run_folder, tmp_path, type_line
):
    """A command would write into the file of the user, for example the prompt into a script."""
    outside = tmp_path / "script.sh"
    outside.write_text("true\n")
    (run_folder / name).parent.mkdir(parents=True, exist_ok=True)
    (run_folder / name).hardlink_to(outside)
    for command, key in (("train", "resume"), ("eval", "run")):
        result = type_line(command, f"{key}={run_folder}")
        assert "got a hard link. Try: " in result.err
    assert outside.read_text() == "true\n"


def test_no_hint_repeats_the_line_in_the_folder_of_a_sweep(tmp_path, type_line):
    """A user would paste it into a shell."""
    plan = {"cwd": ".", "flags": [], "threads": None, "jobs": [], "line": ["$(planted)"], "command": "train"}
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep/jobs.json").write_text(json.dumps(plan))
    for words in (("train", "resume=sweep"), ("export", "run=sweep"), ("eval", "run=sweep")):
        result = type_line(*words)
        assert result.code != 0
        assert "planted" not in result.out + result.err


def test_view_writes_no_report_into_a_folder_with_a_link_out_of_it(tmp_path, type_line):
    (tmp_path / "outside").mkdir()
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep/jobs.json").write_text('{"cwd": ".", "flags": [], "threads": null, "jobs": []}')
    (tmp_path / "sweep/figures").symlink_to(tmp_path / "outside")
    assert "figures: expected a file inside sweep only" in type_line("view", f"run={tmp_path}/sweep").err
    assert not any((tmp_path / "outside").iterdir())


def test_a_new_run_locks_no_file_that_has_a_second_name(tmp_path, type_line):
    outside = tmp_path / "script.sh"
    outside.write_text("true\n")
    (tmp_path / "new").mkdir()
    (tmp_path / "new/.lock").hardlink_to(outside)
    assert "got a hard link" in type_line("train", "prompt=a cube", f"hydra.run.dir={tmp_path}/new").err
    assert outside.read_text() == "true\n"


# --- whole commands ---------------------------------------------------------------------------------------

ROUTES = [
    "+callback.x={_target_: planted.run}",
    "densifier._target_=planted.run",
    "prior.noise_path._target_=planted.run",
    "camera.size={_target_: planted.run}",
    "+metric.x={a: {_target_: planted.run}}",
    "+regularizer.x={_target_: planted.run}",
    "+hydra.callbacks.x._target_=planted.run",
    "hydra.output_subdir=../planted",
    "hydra.mode=MULTIRUN",
    "experiment=../../run/evil",
]


@pytest.mark.parametrize("route", ROUTES)
def test_resuming_a_strangers_run_neither_runs_its_code_nor_changes_it(route, run_folder, marker, type_line):
    evil = "# @package _global_\nhydra: {callbacks: {x: {_target_: planted.run}}}\n"
    (run_folder / "evil.yaml").write_text(evil)
    add_override(run_folder, route)
    before = content(run_folder)
    result = type_line("train", f"resume={run_folder}")
    assert result.code == 1
    assert "overrides.yaml" in result.err
    assert f"Try: cadam3d train resume={run_folder} trust=true" in result.err.replace("'", "")
    assert content(run_folder) == before
    assert not marker.exists()
    assert not (run_folder.parent / "planted").exists()


def test_a_trusted_run_may_run_its_code(run_folder, marker, type_line):
    add_override(run_folder, "+callback.x={_target_: planted.Own}")
    assert type_line("train", f"resume={run_folder}", "trust=true").code == 3
    assert marker.exists()


def test_a_link_in_a_run_is_refused_before_anything_is_written(run_folder, tmp_path, type_line):
    (tmp_path / "precious").write_text("precious")
    (run_folder / "train.log").symlink_to(tmp_path / "precious")
    (run_folder / "config.yaml").write_text("prompt: a")
    for command in ("train", "eval"):
        word = "resume" if command == "train" else "run"
        result = type_line(command, f"{word}={run_folder}")
        assert (result.code, "train.log" in result.err) == (1, True)
    assert (tmp_path / "precious").read_text() == "precious"
    assert sorted(path.name for path in run_folder.iterdir()) == [".hydra", "config.yaml", "train.log"]


@pytest.mark.parametrize("command", ["render", "export"])
def test_nothing_is_written_through_a_link_of_a_run(command, run_folder, tmp_path, type_line):
    (run_folder / "config.yaml").write_text("prompt: a")
    points = Gaussians(*(torch.rand(2, *shape) for shape in ((3,), (3,), (4,), (), (1, 3))))
    write_ply(run_folder / "asset.ply", points, up="-y", pad_sh=0)
    (tmp_path / "precious").mkdir()
    (run_folder / command).symlink_to(tmp_path / "precious")
    result = type_line(command, f"run={run_folder}")
    assert (result.code, "Try: output=/" in result.err) == (1, True)
    assert not list((tmp_path / "precious").iterdir())


def test_a_component_of_config_dir_is_measured_without_trust(tmp_path, monkeypatch, type_line):
    shutil.copytree(CONFIGS / "rasterizer", tmp_path / "mine/rasterizer")
    option = tmp_path / "mine/rasterizer/own.yaml"
    option.write_text("_target_: own_rasterizer.Own\n")
    (tmp_path / "own_rasterizer.py").write_text(
        "from cadam3d.rasterizer.reference import ReferenceRasterizer as Own\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    plain = OmegaConf.to_container(compose(["prompt=a"]), resolve=True)
    assert isinstance(plain, dict)
    plain["rasterizer"] = {"_target_": "own_rasterizer.Own"}
    (tmp_path / "run").mkdir()
    (tmp_path / "run/config.yaml").write_text(yaml.safe_dump(plain))
    refused = type_line("eval", "run=run").err
    assert "config.yaml" not in refused.partition("Try:")[2]
    # The run has no asset, which is the next thing that a command needs.
    assert "has no asset.ply" in type_line("eval", "run=run", "--config-dir", "mine").err
    assert "own_rasterizer.Own" in refused


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="Windows has no modes")
def test_a_folder_that_cannot_be_listed_is_one_message(run_folder):
    if os.geteuid() == 0:
        pytest.skip("root can list any folder")
    (run_folder / "closed").mkdir(mode=0o300)
    with pytest.raises(UserError, match="can be read"):
        require_contained(run_folder, RETRY)
