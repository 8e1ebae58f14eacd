"""``cadam3d train attempts=N``: which attempt is chosen, and why; a small program replaces training."""

import json
import shutil
import sys
from pathlib import Path

import pytest
from declarations import all_numbers, declared

from cadam3d import cli
from cadam3d.settings import compose as settings
from cadam3d.settings import options
from cadam3d.sweep import start
from cadam3d.sweep.choice import Attempt, choose
from cadam3d.sweep.process import run_job
from cadam3d.sweep.table import write_table

REPOSITORY = Path(__file__).parents[2]
TRAIN = """
defaults: [_self_, {metric: [fidelity]}, {hydra: default}, {experiment: null}]
prompt: ???
steps: 5
seed: 0
attempts: 1
select: null
resume: null
trust: false
protocol: null
metric: {}
"""


# --- the choice, on plain numbers -------------------------------------------------------------------------


NUMBERS = all_numbers()
SELECTABLE = [name for name, number in NUMBERS.items() if number.is_more_better is not None]


def attempt(seed: int, numbers: dict) -> Attempt:
    """Return an attempt with what is declared about its numbers."""
    return Attempt(seed, numbers, NUMBERS)


def attempts(*values: float | None, name: str = "psnr") -> list[Attempt]:
    """Return attempts with the seeds 0, 1, ..., of which those with None have no number."""
    return [attempt(seed, {} if value is None else {name: value}) for seed, value in enumerate(values)]


def test_the_best_has_most_or_least_depending_on_the_number():
    for name in SELECTABLE:
        choice = choose(attempts(2.0, 3.0, 1.0, name=name), name)
        assert choice.best == (1 if NUMBERS[name].is_more_better else 2), name


def test_of_equal_attempts_the_one_with_the_lowest_seed_is_chosen_in_any_order():
    equal = attempts(20.0, 24.0, 24.0)
    assert choose(equal, "psnr").best == choose(equal[::-1], "psnr").best == 1


def test_attempts_without_the_number_are_left_out_and_named():
    choice = choose(attempts(None, 24.0, None, 21.0), "psnr")
    assert (choice.best, choice.without) == (1, [0, 2])
    assert "seed=0 has none; seed=2 has none" in choice.sentence


def test_nothing_is_chosen_if_no_attempt_has_the_number():
    assert choose(attempts(None, None), "psnr") is None
    assert choose(attempts(20.0, 21.0), "clip_score") is None
    assert choose([], None) is None


def test_without_a_name_the_truth_counts_before_what_models_say():
    known = {"clip_score": 30.0, "image_reward": 0.5, "num_gaussians": 100.0}
    assert choose([attempt(0, known)], None).number.name == "image_reward"
    assert choose([attempt(0, {**known, "psnr": 20.0})], None).number.name == "psnr"


def test_the_psnr_of_an_asset_that_may_face_any_side_is_that_at_the_best_turn():
    found = choose(
        [attempt(0, {"psnr": 9, "psnr_turned": 20}), attempt(1, {"psnr": 8, "psnr_turned": 21})], "psnr"
    )
    assert (found.best, found.number.name) == (1, "psnr_turned")


# --- the command ------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def attempt_configs(tmp_path_factory) -> Path:
    """Return a folder with the real groups that attempts need and a train.yaml that composes fast."""
    folder = tmp_path_factory.mktemp("configs")
    for name in ("hydra", "metric", "launcher"):
        shutil.copytree(REPOSITORY / "configs" / name, folder / name)
    for path in (REPOSITORY / "configs").glob("*.yaml"):
        shutil.copy(path, folder)
    (folder / "grid").mkdir()
    (folder / "experiment").mkdir()
    (folder / "experiment" / "three.yaml").write_text("# @package _global_\nattempts: 3\n", encoding="utf-8")
    (folder / "train.yaml").write_text(TRAIN, encoding="utf-8")
    return folder


@pytest.fixture
def train(monkeypatch, capfd, tmp_path, attempt_configs, stand_in):
    """Type ``cadam3d train ...`` in an empty folder; a loop runs the jobs, and no report is written."""

    def run_jobs(name: str, arguments: list[str], _run: object) -> None:
        given = dict(line.split("=", 1) for line in arguments if "=" in line)
        folder = Path(given["hydra.sweep.dir"].strip("'"))
        for number in given["job"].split(","):
            run_job(folder, int(number))
            write_table(folder)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONSAFEPATH", "1")
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    for module in (settings, options):
        monkeypatch.setattr(module, "config_dir", lambda: attempt_configs)
    monkeypatch.setattr(sys, "executable", str(stand_in))
    monkeypatch.setattr(start, "run_hydra", run_jobs)
    monkeypatch.setattr("cadam3d.report.write_sweep", lambda folder: folder / "report.html")

    def run(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["cadam3d", "train", *words])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        captured = capfd.readouterr()
        return int(ended.value.code or 0), captured.out, captured.err

    return run


def only_folder() -> Path:
    [folder] = [path for path in Path("outputs").iterdir() if not path.is_symlink()]
    return folder


LINE = ("prompt=an attempt", "attempts=4")
TWO = ("prompt=an attempt", "attempts=2")


def test_every_attempt_is_kept_and_the_best_is_linked(train):
    code, out, _ = train(*LINE, "select=psnr")
    folder = only_folder()
    assert code == 0
    assert folder.name.startswith("an-attempt_")
    assert [path.name for path in sorted(folder.glob("seed=*"))] == ["seed=0", "seed=1", "seed=2", "seed=3"]
    assert (folder / "best").readlink() == Path("seed=1")  # seed=3 has the same PSNR
    assert Path("outputs/latest").resolve() == folder.resolve()
    choice = json.loads((folder / "best.json").read_text())
    assert (choice["best"], choice["select"]) == ("seed=1", "psnr")
    assert choice["values"] == {"seed=1": 23.5, "seed=3": 23.5, "seed=2": 22.25, "seed=0": 21.0}
    assert f"\n{choice['why']}\n" in out
    assert f"cadam3d view run={folder}/seed=1\n" in out


def test_the_same_line_trains_only_what_is_left(train, calls):
    train(*LINE)
    folder = only_folder()
    (folder / "seed=2" / "summary.json").unlink()
    (folder / "best").unlink()
    code, out, _ = train(*LINE)
    assert (code, "4 attempts in" in out and "3 with a result" in out) == (0, True)
    assert [call["folder"] for call in calls(folder)] == ["seed=0", "seed=1", "seed=2", "seed=3", "seed=2"]
    assert (folder / "best").readlink() == Path("seed=1")


def test_more_attempts_and_another_number_find_those_that_exist(train, calls):
    train("prompt=an attempt", "attempts=2")
    folder = only_folder()
    assert train("prompt=an attempt", "attempts=3", "select=num_gaussians")[0] == 0
    assert only_folder() == folder
    assert len(calls(folder)) == 3
    assert (folder / "best").readlink() == Path("seed=0")  # of equal ones


def test_a_job_is_a_single_run_without_the_settings_of_the_attempts(train, calls):
    train(*LINE, "select=psnr", "steps=7", "launcher=joblib")
    words = calls(only_folder())[1]["words"]
    assert words[:3] == ["train", "prompt='an attempt'", "steps=7"]
    assert words[3] == "seed=1"
    assert not any(word.startswith(("attempts=", "select=", "launcher")) for word in words)


def test_attempts_of_a_recipe_do_not_start_attempts(train, calls):
    assert train("prompt=an attempt", "experiment=three")[0] == 0
    assert ["attempts=1" in call["words"] for call in calls(only_folder())] == [True] * 3


def test_failed_attempts_are_left_out_and_the_exit_code_says_so(train):
    code, _, err = train("prompt=a bug", "attempts=2")
    assert code == 1
    assert "2 of 2 attempts without a result (2 failed)" in err
    assert not (only_folder() / "best").exists()


def test_an_attempt_that_lost_every_gaussian_is_never_the_best(train):
    train("prompt=an attempt", "attempts=2")
    summary = only_folder() / "seed=1" / "summary.json"
    numbers = json.loads(summary.read_text()) | {"outcome": "vanished", "num_gaussians": 0, "psnr": 90.0}
    summary.write_text(json.dumps(numbers))
    for select in ("psnr", "num_gaussians"):
        assert train("prompt=an attempt", "attempts=2", f"select={select}")[0] == 0
        assert (only_folder() / "best").readlink() == Path("seed=0")


def test_a_number_that_no_chosen_metric_measures_is_refused_before_anything_runs(train):
    code, _, err = train(*LINE, "select=clip_score")
    assert code == 1
    assert "select: expected metrics that measure clip_score, got 'fidelity'." in err
    assert err.endswith("Try: 'metric=[fidelity,clip_score]'\n")
    assert not Path("outputs").exists()


def test_a_number_of_a_later_evaluation_counts(train):
    train(*TWO)
    folder = only_folder()
    for seed in range(2):
        number = {"num_gaussians": 5, "clip_score": 30.0 - seed}
        (folder / f"seed={seed}" / "eval.json").write_text(json.dumps(declared(number)))
    assert train(*TWO, "select=clip_score")[0] == 0
    assert (folder / "best").readlink() == Path("seed=0")


def test_attempts_without_the_number_are_kept_and_the_message_says_how_to_measure_them(train):
    code, _, err = train("prompt=an attempt", "attempts=2", "select=psnr_min")
    assert code == 1
    assert "select: no attempt has psnr_min." in err
    assert err.endswith(f"Try: cadam3d eval run={only_folder()} 'metric=[fidelity]'\n")


def test_numbers_that_were_measured_in_different_ways_are_not_compared(train):
    train("prompt=an attempt", "attempts=2")
    for seed, protocol in enumerate(("paper", "t3bench")):
        number = {"num_gaussians": 5, "clip_score": 30.0 + seed}
        number["measurements"] = {"clip_score": {"protocol": {"name": protocol}}}
        (only_folder() / f"seed={seed}" / "eval.json").write_text(json.dumps(declared(number)))
    code, _, err = train("prompt=an attempt", "attempts=2", "select=clip_score")
    assert (code, "clip_score was measured in different ways: protocol.name is" in err) == (1, True)
    assert (only_folder() / "best").readlink() == Path("seed=1")  # as before, by psnr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["attempts=0"], "attempts: expected a whole number >= 1 and <= 1000, got 0."),
        (["attempts=2", "select=psnrr"], "Try: select=psnr"),
        (["attempts=2", "metric=[]"], "Try: 'metric=[fidelity]'"),
        (["attempts=1", "dry_run=true"], "dry_run: expected a sweep or several attempts"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_runs(words, message, train):
    code, _, err = train("prompt=an attempt", *words)
    assert (code, message in err) == (1, True), err
    assert not Path("outputs").exists()
    assert not Path("multirun").exists()


def test_the_folder_of_a_run_and_one_with_a_file_called_best_are_refused(train):
    Path("mine/best").mkdir(parents=True)
    code, _, err = train(*LINE, "hydra.run.dir=mine")
    assert code == 1
    assert err == "cadam3d: hydra.run.dir: mine holds best. Try: hydra.run.dir=mine-2\n"


def test_a_dry_run_lists_the_attempts_in_the_same_folder_also_if_they_are_trusted(train):
    (code, plain, _), (_, trusted, _) = (train(*LINE, "dry_run=true", *more) for more in ([], ["trust=true"]))
    assert code == 0
    assert plain.startswith("4 attempts in outputs/an-attempt_")
    assert plain.count("to run") == 4
    assert plain.split()[3] == trusted.split()[3]
    assert not Path("outputs").exists()
