"""The first run on a GPU, without a GPU: pieces, verdicts, the record and the report."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))  # as Python does for a script

import gpu
from gpu_run import machine, session
from gpu_run.machine import Device, TroubleError, find_device, require_nvcc
from gpu_run.pieces import PARTS, RESULT, Piece, most_processes, plan
from gpu_run.session import FAILED, PASSED, SKIPPED, judge

REPOSITORY = Path(__file__).parents[1]
DEVICE = Device("A card", "8.6", 8 * 2**30, "12.4")
EVERYTHING = dict.fromkeys([*machine.TOOLS, *machine.PACKAGES], "1")


class FakeDriver:
    """Answers as the library of a driver does: by default with one device and without an error."""

    def __init__(self, status=0, devices=1, cuda=12040, mode=0):
        self.status, self.devices, self.cuda, self.mode = status, devices, cuda, mode

    def cuInit(self, _):  # noqa: N802
        return self.status

    def cuDeviceGetCount(self, count):  # noqa: N802
        count._obj.value = self.devices
        return 0

    def cuDriverGetVersion(self, version):  # noqa: N802
        version._obj.value = self.cuda

    def cuDeviceGetName(self, name, size, index):  # noqa: N802
        name.value = b"A card"

    def cuDeviceTotalMem_v2(self, size, index):  # noqa: N802
        size._obj.value = 8 * 2**30

    def cuDeviceGetAttribute(self, value, attribute, index):  # noqa: N802
        value._obj.value = {75: 8, 76: 6, 20: self.mode}[attribute]


def test_the_driver_describes_the_first_device():
    assert find_device(lambda _: FakeDriver()) == DEVICE


@pytest.mark.parametrize("driver", [FakeDriver(status=100), FakeDriver(status=803), FakeDriver(devices=0)])
def test_a_driver_that_offers_no_device_is_reported(driver):
    with pytest.raises(TroubleError, match="finds no device"):
        find_device(lambda _: driver)


def test_one_process_at_a_time_uses_a_gpu_in_exclusive_mode():
    assert most_processes(find_device(lambda _: FakeDriver(mode=3)), 16) == 1
    assert most_processes(find_device(lambda _: FakeDriver()), 16) == 2


@pytest.mark.parametrize(
    ("torch_cuda", "says", "fits"),
    [
        ("13.0", "Cuda compilation tools, release 13.2, V13.2.1", True),
        ("12.6", "Cuda compilation tools, release 12.4, V12.4.9", True),
        ("13.0", "Cuda compilation tools, release 12.9, V12.9.0", False),
        ("12.8", "Cuda compilation tools, release 13.0, V13.0.1", False),
        ("13.0", "Segmentation fault", False),
    ],
)
def test_gsplat_is_built_only_by_an_nvcc_of_the_cuda_of_torch(torch_cuda, says, fits, tmp_path):
    nvcc = tmp_path / "nvcc"
    nvcc.write_text(f"#!/bin/sh\necho '{says}'\n")
    nvcc.chmod(0o755)
    if fits:
        require_nvcc(torch_cuda, str(nvcc))
        return
    with pytest.raises(TroubleError) as caught:
        require_nvcc(torch_cuda, str(nvcc))
    # What a machine lacks is not a failure.
    piece = Piece("gsplat", ("gsplat",), 1.0)
    assert judge(piece, 1, f"TroubleError: {caught.value}", None)[0] == SKIPPED


@pytest.mark.skipif(Path("/dev/nvidia0").exists(), reason="there is a GPU")
def test_a_machine_without_a_gpu_gets_one_line_and_needs_no_package(tmp_path):
    # -S: without site-packages, so no package can be imported.
    command = [sys.executable, "-S", str(REPOSITORY / "scripts" / "gpu.py")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(r"gpu: expected an NVIDIA GPU, got none: .*\n", done.stderr)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("driver_cuda", "requirement"), [("12.0", "torch<2.11"), ("12.9", "torch<2.11"), ("13.0", "torch")]
)
def test_the_torch_that_is_installed_runs_with_the_driver(driver_cuda, requirement):
    assert machine.fitting_torch(driver_cuda) == requirement


def test_pieces_fit_into_their_parts_which_take_less_than_ten_minutes(tmp_path):
    for part, seconds in PARTS.items():
        assert sum(piece.seconds for piece in plan(part, tmp_path, EVERYTHING, 6)) <= seconds, part
        # The stages of the kernels are compared only after a failed check.
        around = session.FACTS.seconds + session.STAGES.seconds * (part == "checks")
        assert seconds + around < 600, part
    assert sum(PARTS.values()) + session.FACTS.seconds <= 36 * 60


def test_only_wrong_kernels_keep_the_rest_from_running(tmp_path):
    pieces = [piece for part in PARTS for piece in plan(part, tmp_path, EVERYTHING, 6)]
    gates = [piece.name for piece in pieces if piece.is_gate]
    assert gates == ["self-test", "difficult scenes and the long sort"]


def test_every_script_and_every_option_of_a_piece_exists(tmp_path):
    from gpu_run.on_device import WORK

    for piece in (piece for part in PARTS for piece in plan(part, tmp_path, EVERYTHING, 6)):
        command = list(piece.command)
        files = [word.removeprefix("--ignore=") for word in command if word.endswith(".py")]
        assert all((REPOSITORY / file).is_file() for file in files), piece
        if "gpu_run.on_device" in command:
            assert command[command.index("gpu_run.on_device") + 1] in WORK
        elif "bench_" in command[1]:
            source = Path(command[1]).read_text()
            # BooleanOptionalAction makes --no-stages of --stages.
            options = [word.replace("--no-", "--") for word in command if word.startswith("--")]
            assert all(f'"{option}"' in source for option in options), piece


@pytest.mark.parametrize(
    ("piece", "code", "log", "status"),
    [
        ("tests", 0, "..\n== 201 passed, 3 skipped in 60.1s ==", PASSED),
        ("tests", 0, "201 skipped, 994 deselected in 1.20s", FAILED),
        ("tests", 1, "FAILED tests/a.py::test_b - x\n1 failed, 3 passed in 1s", FAILED),
        ("tests", None, "...", FAILED),
        ("memcheck", None, "========= COMPUTE-SANITIZER", SKIPPED),
        ("memcheck", 0, "agrees\n========= ERROR SUMMARY: 0 errors", PASSED),
        ("memcheck", 1, "========= ERROR SUMMARY: 3 errors", FAILED),
        ("racecheck", 0, "========= RACECHECK SUMMARY: 2 hazards displayed (2 errors)", FAILED),
        ("racecheck", 1, "========= Device not supported. Please refer to the docs", SKIPPED),
        ("difficult scenes and the long sort", 0, "check cuda: agrees with the reference", PASSED),
        ("difficult scenes and the long sort", 1, "check cuda: FAILED, not timed\n  needles", FAILED),
        ("self-test", 1, "ModuleNotFoundError: No module named 'torch'", FAILED),
        ("demo", 1, "ModuleNotFoundError: No module named 'skimage'", SKIPPED),
        ("demo", -11, "Segmentation fault", FAILED),
    ],
)
def test_a_piece_is_judged_by_its_exit_code_and_its_log(piece, code, log, status, tmp_path):
    pieces = [each for part in PARTS for each in plan(part, tmp_path, EVERYTHING, 6)]
    [chosen] = [each for each in pieces if each.name == piece]
    found, says = judge(chosen, code, log, None)
    assert found == status
    assert says
    assert "\n" not in says


def python(name: str, code: str, seconds: float = 60.0, **options) -> Piece:
    """Return a piece that runs some Python; ``out`` is the path of its results."""
    code = f"import json, pathlib, sys; out = pathlib.Path(sys.argv[1])\n{code}"
    return Piece(name, (sys.executable, "-c", code, RESULT), seconds, **options)


ROW = {"count": 20_000, "size": 512, "views": 1, "degree": 0}
ROWS = [ROW | {"backend": "cuda", "step_ms": 0.45}, ROW | {"backend": "gsplat", "step_ms": 0.91}]


@pytest.fixture
def started(tmp_path, monkeypatch):
    """Return a function that runs parts with small pieces, as on a machine with a GPU."""
    monkeypatch.setenv("PYTHONPATH", "")
    broken = tmp_path / "broken"
    found = {
        "checks": [python("self-test", f"sys.exit(pathlib.Path({str(broken)!r}).exists())", is_gate=True)],
        "times": [
            python("choice of auto", 'out.write_text(\'{"backend": "cuda"}\')'),
            python("times", f"out.write_text(json.dumps({{'rows': {ROWS}}}))"),
        ],
        "explains": [python("absent", "", needs=("nvcc",))],
        "sanitizers": [],
        "gsplat": [python("beside gsplat", "", after="absent")],
    }
    monkeypatch.setattr(session, "plan", lambda part, *_: found[part])
    monkeypatch.setattr(session, "STAGES", python("stages", "print('the first wrong stage is x')"))
    monkeypatch.setattr(session, "find_tools", dict)

    def run(*parts, driver="550.1"):
        facts = python("machine", 'out.write_text(\'{"torch": "2.9"}\')')
        monkeypatch.setattr(session, "FACTS", facts)
        monkeypatch.setattr(session, "first_line", lambda *_: driver)
        code = session.run(tmp_path, DEVICE, list(parts or PARTS))
        return code, json.loads((tmp_path / "gpu.json").read_text())["pieces"]

    return run


def test_a_run_can_be_made_in_three_parts_and_repeats_nothing(started, tmp_path, capsys):
    for part in PARTS:
        code, pieces = started(part)
        assert code == 0
    assert {name: entry["status"] for name, entry in pieces.items()} == {
        "self-test": PASSED,
        "choice of auto": PASSED,
        "times": PASSED,
        "absent": SKIPPED,
        "beside gsplat": SKIPPED,
    }
    text = (tmp_path / "gpu.md").read_text()
    assert "| 20000 | 512 | 1 | 0 | gsplat | 0.91 |" in text
    assert "| 20000 | 512 | 1 | 0 | cuda | cuda | True |" in text
    capsys.readouterr()
    assert started()[1]["times"] == pieces["times"]
    assert "times: kept" in capsys.readouterr().out


def test_a_failed_check_stops_the_run_and_names_the_stage(started, tmp_path):
    (tmp_path / "broken").touch()
    code, pieces = started()
    assert code == 1
    assert list(pieces) == ["self-test", "stages"]
    assert pieces["stages"]["says"] == "the first wrong stage is x"
    with pytest.raises(machine.TroubleError, match="no pass of self-test"):
        started("times")


def test_another_driver_starts_over_and_keeps_the_old_results(started, tmp_path):
    started()
    assert list(started("checks", driver="560.2")[1]) == ["self-test"]
    [old] = tmp_path.glob("gpu-*.json")
    assert len(json.loads(old.read_text())["pieces"]) == 5


def test_a_piece_that_hangs_is_ended_with_its_children(tmp_path):
    marker = tmp_path / "still there"
    child = f"import time, pathlib; time.sleep(2); pathlib.Path({str(marker)!r}).touch()"
    code = "import subprocess; print('on it', flush=True); "
    piece = python("hangs", code + f"subprocess.run([sys.executable, '-c', {child!r}])")
    status, says, _ = session.run_process(piece, 0.7, tmp_path)
    assert status == FAILED
    assert "its last line: on it" in says
    time.sleep(1.6)
    assert not marker.exists()


def test_a_driver_that_is_too_old_is_reported_before_anything_is_installed(monkeypatch, capsys):
    monkeypatch.setattr(gpu, "find_device", lambda: Device("A card", "8.6", 2**33, "11.8"))
    assert gpu.main(["--look"]) == 1
    assert "expected a driver for CUDA 12" in capsys.readouterr().err
