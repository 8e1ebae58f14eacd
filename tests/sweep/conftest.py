"""A small program that replaces ``cadam3d train``, so that tests of sweeps are fast."""

import json
import sys
from pathlib import Path

import pytest

# Called as: PROGRAM -P -m cadam3d.job PARENT train key=value ...
# It appends its call to calls.jsonl beside the job folders, and prompt= decides how it ends. "running" lists
# the processes of earlier calls for the same job that have not ended.
STAND_IN = r"""#!{python} -S
import json, os, pathlib, signal, sys, time
given = dict(word.lstrip("+~").partition("=")[::2] for word in sys.argv[6:] if "=" in word)
folder = pathlib.Path(given["hydra.run.dir"].strip("'"))
beside, parent = folder.parent, int(sys.argv[4])
log = beside / "calls.jsonl"
earlier = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []

def is_running(pid):
    try:
        return pathlib.Path(f"/proc/{{pid}}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False

note = {{"folder": folder.name, "words": sys.argv[5:], "threads": os.environ.get("OMP_NUM_THREADS")}}
note["pid"] = os.getpid()
same_job = [call["pid"] for call in earlier if call["folder"] == folder.name]
note["running"] = [pid for pid in same_job if is_running(pid)]
note["path"] = os.environ.get("PYTHONPATH")
note["files"] = sorted(path.name for path in folder.iterdir())
with log.open("a") as file:
    file.write(json.dumps(note) + "\n")
prompt = "a cube" if "resume" in given else given.get("prompt", "'a cube'").strip("'")
steps, seed = int(given.get("steps", 5)), int(given.get("seed", 0))
summary = dict(prompt=prompt, seed=seed, num_gaussians_initial=4, num_gaussians=steps, seconds=1.5)
summary |= dict(steps=steps, steps_asked=steps)
psnr = dict(label="PSNR", unit="dB", digits=2, is_more_better=True, preference=10, metric="fidelity")
summary["numbers"] = dict(psnr=psnr | dict(needs_truth=True))

def write(outcome, **more):
    (folder / "summary.json").write_text(json.dumps(dict(summary, outcome=outcome) | more))

def stop(number, frame):
    write("interrupted", warnings=[])
    sys.exit(128 + number)

signal.signal(signal.SIGINT, stop)
print("training", prompt, flush=True)
if prompt == "a bug":
    print("Traceback (most recent call last):\n  ...\nValueError: one two")
    sys.exit(1)
if prompt == "a mistake":
    print("Note: before\ncadam3d: prompt: expected\n  a shape. Try: a cube")
    sys.exit(1)
if prompt == "a scancel":
    os.kill(os.getpid(), signal.SIGTERM)
if prompt == "a kill":
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / "step_0000002.pt").touch()
    if (folder.parent / "config.yaml").is_file():
        (folder / "config.yaml").write_bytes((folder.parent / "config.yaml").read_bytes())
    write("finished")  # without warnings, so before the exports
    os.kill(os.getpid(), signal.SIGKILL)
if prompt == "a stuck one":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
if prompt in ("a wait", "a stuck one"):
    (folder / "waiting").touch()
    time.sleep(60)
if prompt == "a long one":  # until the test ends it
    (folder / "waiting").touch()
    deadline = time.monotonic() + 60
    while not (beside / "go").exists() and time.monotonic() < deadline:
        if os.getppid() != parent and (beside / "end").exists():
            sys.exit(1)
        time.sleep(0.02)
if prompt == "an attempt":  # which of them is the best depends on the seed
    write("finished", psnr=[21.0, 23.5, 22.25, 23.5, 20.0][seed], asset_bytes=340, warnings=[])
    sys.exit(0)
if prompt == "a vanishing":
    write("vanished", **{{"num_gaussians": 0, "psnr": 50.0, "warnings": []}})
    sys.exit(0)
if prompt == "a crowd":
    write("out_of_memory", warnings=[])
    sys.exit(0)
write("finished", psnr=20.25, ssim=0.5, asset_bytes=340, warnings=[])
"""


@pytest.fixture
def stand_in(tmp_path_factory) -> Path:
    """Return the path of the program, for ``sys.executable``."""
    path = tmp_path_factory.mktemp("bin") / "train"
    path.write_text(STAND_IN.format(python=sys.executable), encoding="utf-8")
    path.chmod(0o755)
    return path


@pytest.fixture
def calls():
    """Return a function that reads the calls of the program in the folder of a sweep."""

    def read(sweep: Path) -> list[dict]:
        path = sweep / "calls.jsonl"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []

    return read
