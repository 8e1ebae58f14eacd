"""The command line: commands, quoting, hints, error messages, sweeps, resuming and completion."""

import errno
import inspect
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from omegaconf.errors import ConfigAttributeError

from cadam3d import cli
from cadam3d.commands.beginning import begun
from cadam3d.core.errors import UserError
from cadam3d.io.occupied import occupied
from cadam3d.io.records import read_config
from cadam3d.io.run_folder import OVERRIDES, claim
from cadam3d.launch import launch
from cadam3d.settings import compose as settings
from cadam3d.settings import options
from cadam3d.settings.line import PATH_KEYS, quoted, read_flags, resumed, text_of
from cadam3d.trainer import Trainer

REPOSITORY = Path(__file__).parent.parent
DENSIFIERS = sorted(path.stem for path in (options.config_dir() / "densifier").glob("*.yaml"))
AWKWARD = (
    "a corgi, front view",
    "what's up with a=b and [small] {blue} (red)",
    "a torus with emoji 😀 and 一座灯塔",
    "null",
    "12",
    "a \\' both and a backslash at the end \\",
    "\\${escaped}, ${oc.env:HOME} and ${open",
    " 'half quoted: hash # percent %\n",
    "???!",
)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((None, None), ("PASSIVE", "3000")),
        (("ACTIVE", None), ("ACTIVE", None)),
        ((None, "7"), ("PASSIVE", "7")),
    ],
)
def test_idle_threads_spin_briefly_and_sleep_unless_the_user_decides(before, after, type_line, monkeypatch):
    names = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
    for name, value in zip(names, before, strict=True):
        monkeypatch.setenv(name, "to be restored")
        if value is None:
            monkeypatch.delenv(name)
        else:
            monkeypatch.setenv(name, value)
    type_line("--version")
    assert tuple(os.environ.get(name) for name in names) == after


@pytest.fixture(scope="session")
def small_configs(tmp_path_factory) -> Path:
    """Return a folder with the real groups that a line needs and a train.yaml that composes fast."""
    folder = tmp_path_factory.mktemp("configs")
    for name in ("hydra", "densifier", "grid", "launcher"):
        shutil.copytree(REPOSITORY / "configs" / name, folder / name)
    shutil.copy(REPOSITORY / "configs/sweep.yaml", folder)
    train = "defaults: [{densifier: cadam}, {hydra: default}, _self_]\n"
    train += "published_baseline: {tau_pos: 0.0002, views: sum_norm, grad_multiplier: 1.0}\n"
    train += "refine: {interval: 50}\nprompt: ???\nnegative_prompt: ''\nsteps: 600\nseed: 0\nresume: null\n"
    (folder / "train.yaml").write_text(train, encoding="utf-8")
    return folder


class Jobs(list):
    """The runs that have started, as configuration and folder, and what goes wrong in the next one."""

    refusal: BaseException | None = None  # before anything is written
    failure: BaseException | None = None  # afterwards


@pytest.fixture
def jobs(monkeypatch, small_configs) -> Jobs:
    """Replace training: record the configuration, claim the folder, and write a summary."""
    for module in (settings, options):
        monkeypatch.setattr(module, "config_dir", lambda: small_configs)
    seen = Jobs()

    def optimise(cfg, call, stop, callbacks=()):
        resume = Path(cfg.resume) if cfg.resume else None
        with occupied(call.folder, is_chosen=call.has_chosen_folder, resume=resume) as folder:
            seen.append((cfg, folder))
            if seen.refusal is not None:
                raise seen.refusal
            with begun(cfg, call, folder):
                if seen.failure is not None:
                    raise seen.failure
                summary = {"prompt": cfg.prompt, "seed": cfg.seed, "outcome": "finished", "steps": cfg.steps}
                summary |= {"num_gaussians": 5, "asset_bytes": 340, "seconds": 1.5, "psnr": 20.25}
                (folder / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
        return folder, summary

    monkeypatch.setattr("cadam3d.commands.train.optimise", optimise)
    return seen


# --- help, version, the command word --------------------------------------------------------------------


def test_help_shows_every_command_on_one_line(type_line):
    result = type_line("--help")
    assert result.code == 0
    for command in cli.COMMANDS:
        assert len([line for line in result.out.splitlines() if line.startswith(f"  {command} ")]) == 1
    assert max(len(line) for line in result.out.splitlines()) <= 110


def test_version(type_line):
    assert type_line("--version").out.startswith("cadam3d 0.")


def test_help_is_instant_and_imports_nothing_heavy():
    code = (
        "import sys, time; start = time.perf_counter()\n"
        "from cadam3d.cli import dispatch; dispatch(['--help'])\n"
        "assert time.perf_counter() - start < 0.5\n"
        "assert not {'torch', 'numpy', 'hydra', 'omegaconf'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=REPOSITORY, timeout=60)


WARN = """
import logging, sys, warnings
from cadam3d import cli
def dispatch(words):
    warnings.warn("of a library")
    logging.getLogger("matplotlib").warning("of a library")
    logging.getLogger("matplotlib").error("an error")
    from transformers.utils import logging as of_transformers
    of_transformers.get_logger("transformers.models").warning("of a library")
    return 0
cli.dispatch = dispatch
cli.main()
"""


@pytest.mark.parametrize("chosen", ["", "default"])
def test_warnings_of_other_libraries_are_shown_only_if_python_is_asked_to(chosen):
    environment = {name: text for name, text in os.environ.items() if not name.endswith("_VERBOSITY")}
    environment["PYTHONWARNINGS"] = chosen
    command = [sys.executable, "-c", WARN]
    ended = subprocess.run(
        command, check=True, env=environment, cwd=REPOSITORY, capture_output=True, text=True
    )
    assert ended.stderr.count("of a library") == (3 if chosen else 0)
    assert "an error" in ended.stderr


@pytest.mark.parametrize("command", ["train", "doctor"])
def test_a_command_prints_our_help_page_and_not_that_of_hydra(command, type_line):
    result = type_line(command, "--help")
    assert result.code == 0
    assert f"cadam3d {command}" in result.out
    assert "Hydra" not in result.out


@pytest.mark.parametrize("command", list(cli.COMMANDS))
def test_cfg_job_prints_the_settings_without_running(command, type_line):
    words = ["prompt=a cube", "seed=1,2"] if command == "sweep" else []
    result = type_line(command, *words, "--cfg", "job")
    assert result.code == 0
    assert isinstance(yaml.safe_load(result.out), dict)
    assert not list(Path.cwd().iterdir())


# --- prompts are text -----------------------------------------------------------------------------------


@pytest.mark.parametrize("prompt", AWKWARD)
def test_a_prompt_is_unchanged_in_the_command_and_in_the_config_of_its_run(prompt, tmp_path, type_line, jobs):
    assert type_line("train", f"prompt={prompt}").code == 0
    [(cfg, _)] = jobs
    assert cfg.prompt == prompt
    path = tmp_path / "config.yaml"
    path.write_text(OmegaConf.to_yaml(cfg, resolve=True), encoding="utf-8")
    assert read_config(path)["prompt"] == prompt


def test_quoting_is_undone_by_hydra_and_omegaconf_for_any_text():
    letters = ["\\", "'", '"', "${", "}", "$", "{", ",", "(", "]", "=", " ", "a", "\u65e5", "\n", "#", "?"]
    draw = random.Random(0)
    parser = OverridesParser.create()
    for _ in range(500):
        text = "".join(draw.choices(letters, k=draw.randint(0, 9)))
        value = parser.parse_override(f"prompt={settings.quote(text)}").value()
        assert text == "???" or OmegaConf.create({"prompt": value}).prompt == text


@pytest.mark.parametrize(
    ("value", "prompts"),
    [
        ("a cube,a ball", ["a cube", "a ball"]),
        ("a corgi, front view", ["a corgi, front view"]),
        ("a corgi, front view,what's up", ["a corgi, front view", "what's up"]),
        ("'a corgi,front view','a cat'", ["a corgi,front view", "a cat"]),
        ("choice(cube,ball)", ["cube", "ball"]),
        ("a car (red),${x}", ["a car (red)", "${x}"]),
    ],
)
def test_in_a_sweep_a_comma_without_a_space_starts_the_next_prompt(value, prompts):
    line = quoted(f"prompt={value}", is_sweep=True)
    override = OverridesParser.create().parse_override(line)
    pieces = list(override.sweep_string_iterator()) if override.is_sweep_override() else [line[7:]]
    found = [OverridesParser.create().parse_override(f"prompt={piece}").value() for piece in pieces]
    assert [OmegaConf.create({"prompt": value}).prompt for value in found] == prompts


def test_a_path_with_brackets_and_commas_is_quoted_too(type_line, jobs, tmp_path):
    folder = tmp_path / "a (run), [one]=1"
    assert type_line("train", "prompt=a cube", f"hydra.run.dir={folder}").code == 0
    assert jobs[0][1] == folder


@pytest.mark.parametrize("key", PATH_KEYS)
def test_a_path_in_the_home_folder_is_read_as_text(key):
    for text in ("~/x", "~", "a~b/my mesh (1).ply"):
        line = quoted(f"{key}={text}", is_sweep=False)
        assert OverridesParser.create().parse_override(line).value() == text
        assert text_of(line) == text


def test_a_run_in_the_home_folder_is_written_and_resumed_there(type_line, jobs, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert type_line("train", "prompt=a cube", "hydra.run.dir=~/x").code == 0
    assert type_line("train", "resume=~/x", "hydra.run.dir=~/x").code == 0
    assert [folder for _, folder in jobs] == [tmp_path / "home/x"] * 2


def test_a_component_from_a_folder_of_the_user_is_found(type_line, jobs, tmp_path):
    own = tmp_path / "my configs, (1)/densifier"
    own.mkdir(parents=True)
    (own / "mine.yaml").write_text("_target_: mypackage.Mine\n", encoding="utf-8")
    assert type_line("train", "--config-dir", str(own.parent), "densifier=mine", "prompt=a cube").code == 0
    assert jobs[0][0].densifier._target_ == "mypackage.Mine"


# --- mistakes and bugs ----------------------------------------


def test_hydra_full_error_shows_the_traceback(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.setattr(sys, "argv", ["cadam3d", "train", "densifer=cadam"])
    with pytest.raises(UserError) as caught:
        cli.main()
    assert caught.value.__cause__ is not None


@pytest.mark.parametrize("bug", [ValueError("a bug"), ConfigAttributeError("a bug")])
def test_a_bug_keeps_its_traceback(bug, monkeypatch, tmp_path, jobs):
    monkeypatch.chdir(tmp_path)
    jobs.failure = bug
    with pytest.raises(type(bug), match="a bug"):
        launch("train", ["prompt=a cube"])


# --- where things go ------------------------------------------------------------------------------------


def test_a_run_gets_a_dated_folder_named_after_its_prompt(type_line, jobs, tmp_path):
    type_line("train", "prompt=A red car, (fast)!")
    [(_, folder)] = jobs
    assert folder.parent.parent == tmp_path / "outputs"
    assert folder.name.partition("_")[2] == "A-red-car-fast"
    assert (folder / ".hydra/overrides.yaml").is_file()
    assert (folder / "train.log").is_file()


def test_a_refused_line_makes_no_folder_and_removes_none(type_line, jobs, tmp_path):
    jobs.refusal = UserError("x")
    assert type_line("train", "prompt=a cube").message == "x"
    assert not list(tmp_path.iterdir())
    (tmp_path / "mine").mkdir()
    for place in ("mine/deep/er", "mine"):
        assert type_line("train", "prompt=a cube", f"hydra.run.dir={place}").code == 1
    assert [path.name for path in tmp_path.rglob("*")] == ["mine"]


@pytest.mark.parametrize("is_resumed", [False, True])
@pytest.mark.parametrize("problem", [ValueError("a bug"), KeyboardInterrupt()])
def test_a_run_that_does_not_begin_leaves_the_folder_as_it_was(
    problem, is_resumed, type_line, jobs, tmp_path
):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "notes.txt").write_text("my own")
    words = ["train", "prompt=a cube", "hydra.run.dir=mine"]
    if is_resumed:
        type_line(*words)
        words = ["train", "resume=mine", "steps=20"]
    before = contents(folder)
    jobs.refusal = problem
    with pytest.raises(type(problem)):
        launch(words[0], words[1:])
    assert contents(folder) == before
    assert is_resumed or [path.name for path in folder.iterdir()] == ["notes.txt"]


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_a_run_has_written_stays_however_it_ends(run_folder, type_line, jobs):
    jobs.failure = KeyboardInterrupt()
    assert type_line("train", f"resume={run_folder}", "steps=20").code == 130
    assert "steps=20" in (run_folder / OVERRIDES).read_text()
    assert type_line("train", "prompt=a cube", "hydra.run.dir=begun").code == 130
    assert Path("begun/config.yaml").is_file()


def test_if_the_log_cannot_be_written_nothing_is(run_folder, type_line, jobs):
    (run_folder / "train.log").unlink()
    (run_folder / "train.log").mkdir()
    before = contents(run_folder)
    message = type_line("train", f"resume={run_folder}", "steps=20").message
    assert message.startswith("resume: cannot write to outputs/")
    assert contents(run_folder) == before


def test_a_run_on_a_read_only_disk_is_refused_in_one_line(run_folder, type_line, jobs, monkeypatch):
    def refuse(folder):
        if folder == run_folder:
            raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("cadam3d.io.occupied.require_writable", refuse)
    message = type_line("train", f"resume={run_folder}").message
    assert message.startswith("resume: cannot write to outputs/")
    assert "(Read-only file system). Try: hydra.run.dir=" in message


def test_two_runs_in_one_second_do_not_share_a_folder(tmp_path):
    claims = [claim(tmp_path / "10-00-00_cube", "hydra.run.dir", is_chosen=False) for _ in range(3)]
    assert [folder.name for folder in claims] == ["10-00-00_cube", "10-00-00_cube-2", "10-00-00_cube-3"]
    assert claim(claims[0], "hydra.run.dir", is_chosen=True) == claims[0]


@pytest.mark.parametrize(
    ("parts", "name"),
    [
        (("A red car!",), "A-red-car"),
        (("😀",), "untitled"),
        (("../../etc",), "etc"),
        (("x" * 300,), "x" * 60),
    ],
)
def test_a_slug_is_a_safe_piece_of_a_file_name(parts, name):
    assert settings.slug(*parts) == name


# --- resume ---------------------------------------------------------------------------------------------


@pytest.fixture
def run_folder(type_line, jobs) -> Path:
    assert type_line("train", "prompt=a car, (red)", "densifier=baseline", "steps=10", "seed=3").code == 0
    _, folder = jobs.pop()
    return folder


def test_resume_needs_no_prompt_and_keeps_the_settings_of_the_run(run_folder, type_line, jobs):
    assert type_line("train", f"resume={run_folder}").code == 0
    [(cfg, folder)] = jobs
    assert (cfg.prompt, cfg.steps, cfg.seed) == ("a car, (red)", 10, 3)
    assert "baseline" in cfg.densifier._target_
    assert folder == run_folder
    assert Path(cfg.resume) == run_folder


def test_settings_in_the_line_win_and_are_kept(run_folder, type_line, jobs):
    type_line("train", f"resume={run_folder}", "steps=20", "densifier=cadam")
    type_line("train", f"resume={run_folder}", "seed=4")
    assert [(cfg.steps, cfg.seed) for cfg, _ in jobs] == [(20, 3), (20, 4)]
    assert all("cadam" in cfg.densifier._target_.rpartition(".")[2].lower() for cfg, _ in jobs)


def test_resume_follows_a_link_and_takes_a_checkpoint_file(run_folder, type_line, jobs, tmp_path):
    checkpoint = run_folder / "checkpoints/000010.pt"
    checkpoint.parent.mkdir()
    checkpoint.touch()
    type_line("train", "resume=outputs/latest")
    type_line("train", "resume=outputs/latest/checkpoints/000010.pt")
    assert [folder for _, folder in jobs] == [run_folder, run_folder]
    assert Path(jobs[1][0].resume) == checkpoint


@pytest.mark.parametrize("place", ["nowhere", "."])
def test_resuming_from_a_folder_without_a_run_is_refused(place, type_line, jobs):
    message = type_line("train", f"resume={place}").message
    assert "expected the folder of a run" in message
    assert not jobs


def test_resume_stays_in_its_folder_and_out_of_sweeps(run_folder, type_line):
    assert ", which is resumed" in type_line("train", f"resume={run_folder}", "hydra.run.dir=other").message
    assert "not a sweep" in type_line("sweep", f"resume={run_folder}", "seed=0,1").message


@pytest.mark.parametrize(
    ("before", "anew", "after"),
    [
        (["~refine.b", "+refine.b={c:1}"], [], ["~refine.b", "+refine.b={c:1}"]),
        (["~refine.b", "+refine.b={c:1}"], ["~refine.b"], ["~refine.b"]),
        (["~refine.b"], ["refine.b=5"], ["refine.b=5"]),
        (["refine.b=5", "steps=2"], ["~refine.b"], ["steps=2", "~refine.b"]),
        (["+refine.b=5"], ["+refine.b=6"], ["+refine.b=6"]),
    ],
)
def test_an_override_replaces_those_of_the_run_with_its_key(before, anew, after, tmp_path):
    (tmp_path / ".hydra").mkdir()
    (tmp_path / OVERRIDES).write_text(yaml.safe_dump(before), encoding="utf-8")
    lines = resumed([f"resume='{tmp_path}'", *anew], is_sweep=False)
    assert [line for line in lines if not line.startswith(("resume=", "hydra.run.dir="))] == after


# --- completion -----------------------------------------------------------------------------------------


def complete(line: str, type_line, monkeypatch, shell: str = "bash") -> list[str]:
    monkeypatch.setenv("COMP_LINE", line)
    result = type_line("-sc", f"query={shell}")
    assert result.code == 0
    assert not result.err
    return result.out.split()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("cadam3d ", list(cli.COMMANDS)),
        ("cadam3d e", ["export", "eval"]),
        ("cadam3d train densifier=", [f"densifier={name}" for name in DENSIFIERS]),
        ("cadam3d train densifier.tau_", ["densifier.tau_Q=", "densifier.tau_SNR="]),
        ('cadam3d train prompt="a car, (red)" densifier=cadam_c', ["densifier=cadam_calibrated"]),
        ("cadam3d train 'prompt=a car' densifier=cadam_c", ["densifier=cadam_calibrated"]),
        ("cadam3d sweep grid=th", ["grid=thresholds"]),
        ("cadam3d sweep launcher=jo", ["launcher=joblib"]),
        ("cadam3d doctor js", ["json="]),
        ("cadam3d nothing ", []),
        ("cadam3d train densifier=nope step", []),
    ],
)
def test_the_command_and_the_words_after_it_are_completed(line, expected, type_line, monkeypatch):
    assert complete(line, type_line, monkeypatch) == expected


# --- as a process ---------------------------------------------------------------------------------------


def test_ctrl_c_prints_one_line_and_exits_with_130(tmp_path):
    """The signal comes before the command has installed handlers."""
    code = (
        "import signal, sys, time, types\n"
        # A shell starts background jobs with SIGINT ignored.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "slow = types.ModuleType('cadam3d.commands.train')\n"
        "slow.run = lambda cfg, call: (print('started', flush=True), time.sleep(60))\n"
        "sys.modules[slow.__name__] = slow\n"
        "from cadam3d.cli import main\n"
        "sys.argv = ['cadam3d', 'train', 'prompt=a cube']\n"
        "main()"
    )
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "started\n"
    time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert err.strip() == "cadam3d: interrupted"


def test_an_interrupt_hidden_by_another_exception_is_still_an_interrupt(type_line, monkeypatch, jobs):
    def hide(*args, **kwargs):
        try:
            raise KeyboardInterrupt
        finally:
            raise AttributeError("raised by the clean-up")

    monkeypatch.setattr("cadam3d.launch.compose", hide)
    assert type_line("train", "prompt=a cube").code == 130


def test_a_run_composes_its_settings_once(type_line, jobs, monkeypatch):
    composed = []
    original = settings.hydra.compose
    monkeypatch.setattr(
        settings.hydra, "compose", lambda *args, **more: composed.append(args) or original(*args, **more)
    )
    assert type_line("train", "prompt=a cube", "steps=5").code == 0
    assert len(composed) == 1
    assert type_line("train", "resume=" + str(jobs[0][1])).code == 0
    assert len(composed) == 2


def test_at_most_eight_frames_lie_between_the_shell_and_a_step(type_line, monkeypatch):
    step, stacks = Trainer.step, []

    def climb(*args):
        codes = [each.frame.f_code for each in inspect.stack(context=0)[::-1]]
        own = [code for code in codes if code.co_filename.startswith(str(REPOSITORY / "cadam3d"))]
        stacks.append([f"{Path(code.co_filename).stem}.{code.co_name}" for code in own])
        return step(*args)

    monkeypatch.setattr(Trainer, "step", climb)
    small = ("prior=tiny", "steps=1", "camera.size=8", "initializer.count=9", "exporter=[]", "metric=[]")
    assert type_line("train", "prompt=a cube", "rasterizer=reference", *small).code == 0
    stairs = [*stacks[0], "trainer.step"]
    print(" -> ".join(stairs))
    assert len(stairs) <= 8
    assert len({name.partition(".")[2] for name in stairs}) == len(stairs)


def test_the_overrides_of_a_run_are_recorded_without_those_of_hydra(type_line, jobs):
    type_line("train", "prompt=a cube", "steps=5", "hydra.run.dir=here")
    assert yaml.safe_load(Path("here", OVERRIDES).read_text()) == ["prompt='a cube'", "steps=5"]
    assert {path.name for path in Path("here/.hydra").iterdir()} == {
        "config.yaml",
        "hydra.yaml",
        "overrides.yaml",
    }


def test_flags_may_be_anywhere_in_a_line():
    words = ["a=1", "--resolve", "b=2", "--cfg", "job", "c=3"]
    options, overrides = read_flags(words)
    assert (overrides, options.resolve, options.cfg) == (["a=1", "b=2", "c=3"], True, "job")
