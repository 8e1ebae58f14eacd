"""Which runs a line names, which arms they belong to, and which of them are pairs."""

from pathlib import Path

import pytest

from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import write_json
from cadam3d.study.runs import StudyRun, find_runs, pair_runs, select
from cadam3d.sweep.folder import Job, Plan, write_plan


def make_run(folder: Path, prompt="a cube", seed=0, **facts) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.yaml").touch()
    (folder / "asset.ply").touch()
    write_json(folder / "summary.json", {"prompt": prompt, "seed": seed, "outcome": "finished", **facts})
    return folder


def make_sweep(folder: Path, jobs) -> Path:
    """Make a sweep with a job for each tuple of arm, prompt, seed and further settings."""
    planned = []
    for number, (arm, prompt, seed, more) in enumerate(jobs):
        swept = {"densifier": arm, "prompt": prompt, "seed": seed, **more}
        overrides = [
            f"{key}='{value}'" if key == "prompt" else f"{key}={value}" for key, value in swept.items()
        ]
        make_run(folder / f"job{number}", prompt, seed, densifier=arm, warnings=[])
        planned.append(Job(arm=arm, name=f"job{number}", overrides=overrides, swept=swept))
    write_plan(folder, Plan(cwd=str(folder), flags=[], threads=None, jobs=planned))
    return folder


def paired(found: list[StudyRun], *, same_seed=True):
    pairs = pair_runs(found, same_seed=same_seed)
    return [(pair.prompt, *pair.arms, *(run.folder.name for run in pair.runs)) for pair in pairs]


def find(*places: Path, labels=None) -> list[StudyRun]:
    return find_runs([str(place) for place in places], labels)


def test_runs_are_named_by_their_folders_and_labels_replace_them(tmp_path):
    places = [make_run(tmp_path / name) for name in ("x", "y")]
    assert paired(find(*places)) == [("a cube", "x", "y", "x", "y")]
    assert {run.arm for run in find(*places, labels=["old", "new"])} == {"old", "new"}
    with pytest.raises(UserError, match="labels: expected 2 different names"):
        find(*places, labels=["old", "old"])


def test_folders_with_a_run_per_prompt_are_paired_by_prompt_and_seed(tmp_path):
    for arm in ("A", "B"):
        for name, prompt, seed in (("cube", "a cube", 0), ("cube1", "a cube", 1), ("cone", "a cone", 0)):
            make_run(tmp_path / arm / name, prompt, seed)
    make_run(tmp_path / "A" / "torus", "a torus")
    assert paired(find(tmp_path / "A", tmp_path / "B")) == [
        ("a cone", "A", "B", "cone", "cone"),
        ("a cube", "A", "B", "cube", "cube"),
        ("a cube", "A", "B", "cube1", "cube1"),
    ]


def test_a_sweep_is_compared_arm_by_arm_under_equal_conditions(tmp_path):
    jobs = [
        (arm, prompt, 0, {"guidance": guidance})
        for arm in ("baseline", "cadam")
        for prompt in ("a cube", "a cone")
        for guidance in ("sds", "ism")
    ]
    found = find(make_sweep(tmp_path / "sweep", jobs))
    pairs = pair_runs(found, same_seed=True)
    assert len(pairs) == 4
    for pair in pairs:
        assert pair.arms == ("baseline", "cadam")
        assert pair.runs[0].conditions == pair.runs[1].conditions
        assert ("guidance", dict(pair.runs[0].conditions)["guidance"]) in pair.runs[0].conditions
    assert len({(pair.prompt, pair.runs[0].conditions) for pair in pairs}) == 4


def test_runs_without_an_asset_are_left_out(tmp_path):
    sweep = make_sweep(tmp_path / "sweep", [(arm, "a cube", 0, {}) for arm in ("baseline", "cadam", "none")])
    (sweep / "job2/asset.ply").unlink()
    found = find(sweep)
    assert {run.arm for run in found} == {"baseline", "cadam"}


def test_only_the_chosen_prompts_are_paired(tmp_path):
    jobs = [(arm, prompt, 0, {}) for arm in ("baseline", "cadam") for prompt in ("a cube", "a cone")]
    found = find(make_sweep(tmp_path / "sweep", jobs))
    assert {run.prompt for run in select(found, None, {"a cone", "a torus"})} == {"a cone"}
    with pytest.raises(UserError, match="prompts: expected prompts of the runs"):
        select(found, None, {"a torus"})


def test_other_seeds_are_paired_in_order_on_request_only(tmp_path):
    for arm, seeds in (("A", (3, 1)), ("B", (2, 7, 9))):
        for seed in seeds:
            make_run(tmp_path / arm / f"seed{seed}", seed=seed)
    found = find(tmp_path / "A", tmp_path / "B")
    with pytest.raises(UserError, match="same_seed=false"):
        paired(found)
    assert paired(found, same_seed=False) == [
        ("a cube", "A", "B", "seed1", "seed2"),
        ("a cube", "A", "B", "seed3", "seed7"),
    ]


def test_two_runs_of_one_prompt_and_seed_in_one_arm_are_refused_with_their_names(tmp_path):
    for arm, names in (("A", ("x", "y")), ("B", ("z",))):
        for name in names:
            make_run(tmp_path / arm / name)
    with pytest.raises(
        UserError, match=r"runs: expected one run of each prompt and seed in an arm, got \[.*x.*y"
    ):
        paired(find(tmp_path / "A", tmp_path / "B"))


@pytest.mark.parametrize(
    ("places", "message"),
    [
        (["A"], "runs: expected the folder of a sweep, or a list"),
        (["A", "A"], "labels: expected 2 different names"),
        (["A", "nowhere"], "runs: expected folders of finished runs"),
        (["A", "empty"], "runs: expected folders of finished runs"),
    ],
)
def test_places_that_are_no_arms_are_refused(tmp_path, monkeypatch, places, message):
    make_run(tmp_path / "A")
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=message):
        find_runs(places, None)


def test_an_unknown_arm_is_refused_with_those_there_are(tmp_path):
    found = find(make_sweep(tmp_path / "sweep", [(arm, "a cube", 0, {}) for arm in ("baseline", "cadam")]))
    with pytest.raises(
        UserError, match=r"arms: expected at least two of those with assets \(baseline, cadam\)"
    ):
        select(found, ["cadm", "baseline"], None)
    with pytest.raises(UserError, match="at least two of those with assets"):
        select(found, ["cadam"], None)
