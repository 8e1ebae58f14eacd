"""Every wrong line is one message that names what is wrong; it has exit code 1, and nothing is written."""

from pathlib import Path

import pytest

TRAIN = ("train", "prompt=a red torus", "steps=2")
SWEEP = ("sweep", "prompt=a red torus")
LONG = "x" * 300

# A wrong line, and what its message has to contain.
LINES = [
    (("trian",), "train"),
    (("optimise",), "train|sweep|render"),
    (("--nonsense",), "--nonsense"),
    (("-sc", "install=tcsh"), "install=bash|zsh|fish"),
    (("train",), "prompt: no value given"),
    (("train", "prompt= "), "prompt: expected what to make"),
    (("train", "prompt=a", "red", "torus"), "'red': expected key=value"),
    ((*TRAIN, "step=5"), "steps=5"),
    ((*TRAIN, "densifer=cadam"), "densifier"),
    ((*TRAIN, "densifier.tau_q=0.5"), "densifier.tau_Q=0.5"),
    ((*TRAIN, "tau_SNR=0.2"), "densifier.tau_SNR=0.2"),
    ((*TRAIN, "qqqq.zzzz=5"), "qqqq.zzzz: no such setting"),
    ((*TRAIN, "+x=1"), "x: no such setting"),
    ((*TRAIN, "~steps"), "steps: expected a value"),
    ((*TRAIN, "~nothing"), "nothing"),
    ((*TRAIN, f"{LONG}=1"), "File name too long"),
    ((*TRAIN, "grid=densifiers"), "grid: no such setting"),
    ((*TRAIN, "dry_run=true"), "dry_run: expected a sweep"),
    ((*TRAIN, "densifier=cadm"), "densifier=cadam"),
    ((*TRAIN, "densifier=null"), "densifier: expected one of"),
    ((*TRAIN, "densifier=3"), "densifier: expected one of"),
    ((*TRAIN, "camera=[]"), "camera: expected a value"),
    ((*TRAIN, "callback=[metrics,progres]"), "progress"),
    ((*TRAIN, "+callback.candidates.every=5"), "callback.candidates: is not chosen"),
    ((*TRAIN, "launcher=joblib"), "launcher: expected a sweep"),
    ((*TRAIN, "seed=0,1"), "cadam3d sweep seed=0,1"),
    ((*TRAIN, "exporter=ply,glb"), "exporter=[ply,glb]"),
    (("export", "run=r", "output=torus.fbx"), "Try: for=blender"),
    (("export", "run=r", "output=torus.usdz"), "Try: for=blender"),
    ((*TRAIN, "steps=[1"), "steps: cannot read the value"),
    ((*TRAIN, "steps=abc"), "steps: expected a whole number"),
    ((*TRAIN, "steps=0"), "steps: expected"),
    ((*TRAIN, "seed=-1"), "seed: expected"),
    ((*TRAIN, "device=gpu"), "device"),
    ((*TRAIN, "prompt=a red florb"), "florb"),
    ((*TRAIN, "refine.steps=5"), "refine.steps: expected the length of the run"),
    ((*TRAIN, "guidance._target_=os.system"), "guidance._target_"),
    ((*TRAIN, "steps=${nope}"), "steps: Interpolation key 'nope' not found"),
    ((*TRAIN, "steps=${oc.env:CADAM3D_NOT_SET}"), "steps: "),
    ((*TRAIN, "attempts=0"), "attempts: expected"),
    ((*TRAIN, "resume=nowhere"), "resume: expected the folder of a run"),
    ((*TRAIN, f"resume={LONG}"), "resume: expected"),
    ((*TRAIN, "hydra.run.dir="), "hydra.run.dir: expected a folder"),
    ((*TRAIN, "hydra.run.dir=/dev/null/x"), "hydra.run.dir: cannot write to /dev/null/x"),
    ((*TRAIN, f"hydra.run.dir={LONG}"), "hydra.run.dir: "),
    ((*TRAIN, "hydra.run.dir=taken"), "hydra.run.dir: taken holds summary.json"),
    ((*TRAIN, "hydra.job.chdir=true"), "hydra.job.chdir: cadam3d has no such setting"),
    ((*TRAIN, "--cfg", "nope"), "nope"),
    ((*TRAIN, "--bogus"), "--bogus"),
    ((*TRAIN, "--config-dir", "nowhere"), "--config-dir: expected a folder"),
    ((*TRAIN, "-x"), "-x: no such flag"),
    (SWEEP, "sweep: nothing to sweep over"),
    ((*SWEEP, "sed=0,1"), "seed"),
    ((*SWEEP, "seed=0,1", "attempts=2"), "attempts: expected 1 in a sweep"),
    ((*SWEEP, "seed=0,1", "hydra.run.dir=x"), "hydra.run.dir: expected hydra.sweep.dir"),
    (("render",), "run, ply: expected one of them"),
    (("render", "ply=nowhere.ply"), "nowhere.ply"),
    (("export", "run=[a,b]"), "run: expected one run"),
    (("eval", "run=taken"), "run: expected the folder of a run"),
    (("view", f"run={LONG}"), "path: expected"),
    (("study", "runs"), "'runs': expected key=value"),
    (("doctor", "jsn=true"), "json=true"),
]


@pytest.mark.parametrize(("words", "expected"), LINES, ids=[" ".join(words)[:60] for words, _ in LINES])
def test_a_wrong_line_is_one_message_and_writes_nothing(words, expected, type_line, tmp_path):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/summary.json").write_text("{}")
    result = type_line(*words)
    assert result.code == 1
    assert expected in result.message
    assert " Try: " in result.message
    assert "Traceback" not in result.err
    assert not result.out
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["summary.json", "taken"]


def test_a_path_that_the_system_refuses_is_one_message(type_line, tmp_path):
    Path("circle").symlink_to("circle")
    for line in ("eval run=PATH", "render ply=PATH", "train resume=PATH", "train prompt=a --config-dir PATH"):
        for path in ("circle", LONG, "a/" * 3000):
            message = type_line(*line.replace("PATH", path).split()).message
            assert path not in message.partition("Try: ")[2]
