"""The first run on a GPU, without a GPU: pieces, records, reports and packages."""

import json
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))  # as Python does for a script

import gpu
from gpu_run import machine, markdown, pieces, runner, session
from gpu_run.machine import Device, find_device
from gpu_run.pieces import CHECKS, EXPLAINS, PARTS, TIMES, Setup, plan
from gpu_run.record import ENDED, FAILED, PASSED, SKIPPED, Entry, Record, read_record
from gpu_run.runner import RESULT, Finished, Piece, Processes, Runner

REPOSITORY = Path(__file__).parents[1]
DEVICE = Device("A card", "8.6", 8 * 2**30, 82, "12.4", 1)
MACHINE = {
    "device": "A card",
    "capability": "8.6",
    "memory_bytes": 8 * 2**30,
    "driver": "550.1",
    "driver_cuda": "12.4",
    "torch": "2.9.0+cu128",
    "torch_cuda": "12.8",
    "nvrtc": "12.8 in libnvrtc.so.12",
    "python": "3.12.3",
    "processor": "A processor",
    "commit": "0123456789 with changes",
    "date": "2026-01-02T03:04:05+00:00",
    "tools": {},
    "packages": {"torch": "2.9.0+cu128"},
}


def new_record() -> Record:
    return Record(dict(MACHINE), "state")


def setup(tmp_path, **changes) -> Setup:
    tools = {name: f"/bin/{name}" for name in machine.TOOLS}
    packages = dict.fromkeys(machine.PACKAGES, "1")
    return replace(Setup(tmp_path, tools, packages, 80 * 2**30, 16, new_record()), **changes)


def python(code: str, name: str = "a piece", part: str = CHECKS, **options) -> Piece:
    """Return a piece that runs some Python."""
    return Piece(name, part, (sys.executable, "-c", code, RESULT), options.pop("seconds", 60.0), **options)


def says(text: str, code: int = 0) -> str:
    """Return Python that writes a result and ends."""
    return (
        "import json, pathlib, sys; "
        f"pathlib.Path(sys.argv[1]).write_text(json.dumps({{'says': {text!r}}})); sys.exit({code})"
    )


class Run:
    """A runner in a folder, and what it shows."""

    def __init__(self, folder: Path, record: Record | None = None) -> None:
        self.record, self.path, self.shown = record or new_record(), folder / "gpu.json", []
        self.runner = Runner(self.record, self.path, Processes(folder / "logs", folder), self.shown.append)

    def __call__(self, *run_pieces: Piece, part: str = CHECKS, seconds: float = 60.0) -> bool:
        return self.runner.run(part, run_pieces, seconds)

    def status(self, name: str = "a piece") -> tuple[str, str]:
        entry = self.record.pieces[name]
        return entry.status, entry.says


# -------------------------------------------------------------------------- looking for a GPU


class FakeDriver:
    """Answers as the library of a driver with ``count`` devices does."""

    def __init__(self, count=1, status=0):
        self.count, self.status = count, status

    def cuInit(self, _):  # noqa: N802
        return self.status

    def cuDeviceGetCount(self, count):  # noqa: N802
        count._obj.value = self.count
        return 0

    def cuDriverGetVersion(self, version):  # noqa: N802
        version._obj.value = 12040

    def cuDeviceGetName(self, name, size, index):  # noqa: N802
        name.value = b"A card"

    def cuDeviceTotalMem_v2(self, size, index):  # noqa: N802
        size._obj.value = 8 * 2**30

    def cuDeviceGetAttribute(self, value, attribute, index):  # noqa: N802
        value._obj.value = {75: 8, 76: 6, 16: 82}[attribute]

    def cuGetErrorName(self, status, text):  # noqa: N802
        text._obj.value = b"CUDA_ERROR_NO_DEVICE"


def test_the_driver_describes_the_first_device():
    assert find_device(lambda _: FakeDriver()) == DEVICE


@pytest.mark.skipif(Path("/dev/nvidia0").exists(), reason="there is a GPU")
def test_a_machine_without_a_gpu_gets_one_line_and_needs_no_package(tmp_path):
    # -S: without site-packages, so no package can be imported.
    command = [sys.executable, "-S", str(REPOSITORY / "scripts" / "gpu.py")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout == ""
    assert re.fullmatch(
        r"gpu: expected an NVIDIA GPU, got none: .*libcuda.*\. Try: nvidia-smi\n", done.stderr
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("driver_cuda", "requirement"), [("12.0", "torch<2.11"), ("12.9", "torch<2.11"), ("13.0", "torch")]
)
def test_the_torch_that_is_installed_runs_with_the_driver(driver_cuda, requirement, monkeypatch, capsys):
    monkeypatch.setattr(gpu, "find_device", lambda: replace(DEVICE, driver_cuda=driver_cuda))
    monkeypatch.setattr(gpu, "find_packages", dict)
    assert gpu.main(["--torch"]) == 0
    assert capsys.readouterr().out == f"{requirement}\n"
    monkeypatch.setattr(gpu, "find_packages", lambda: {"torch": "2.9.0+cu128"})
    assert gpu.main(["--torch"]) == 0
    assert capsys.readouterr().out == "", "the one that is there stays"


def test_a_driver_that_is_too_old_is_reported_before_anything_is_installed(monkeypatch, capsys):
    monkeypatch.setattr(gpu, "find_device", lambda: replace(DEVICE, driver_cuda="11.8"))
    assert gpu.main(["--look"]) == 1
    assert re.fullmatch(r"gpu: expected a driver for CUDA 12 .*11\.8\. Try: .*\n", capsys.readouterr().err)


# -------------------------------------------------------------------------- pieces


def test_a_piece_that_has_passed_is_not_repeated(tmp_path):
    run = Run(tmp_path)
    assert run(python(says("first")))
    again = Run(tmp_path, read_record(run.path))
    assert again(python(says("second")))
    assert again.status() == (PASSED, "first")
    assert again.shown == ["  a piece: kept, first"]


def test_nothing_follows_a_gate_that_fails(tmp_path):
    run = Run(tmp_path)
    assert not run(python(says("wrong", code=1), is_gate=True), python(says("fine"), "the next"))
    assert list(run.record.pieces) == ["a piece"]


def test_a_piece_that_hangs_is_ended_with_its_children(tmp_path):
    marker = tmp_path / "still there"
    child = f"import time, pathlib; time.sleep(2); pathlib.Path({str(marker)!r}).touch()"
    code = "import subprocess, sys; print('on it', flush=True); "
    code += f"subprocess.run([sys.executable, '-c', {child!r}])"
    run = Run(tmp_path)
    assert run(python(code, seconds=0.7), python(says("fine"), "the next"))
    status, line = run.status()
    assert status == ENDED
    assert "its last line: on it" in line
    assert run.status("the next") == (PASSED, "fine")
    time.sleep(1.6)
    assert not marker.exists()


def test_a_missing_package_is_named_and_does_not_stop_the_run(tmp_path):
    run = Run(tmp_path)
    assert run(
        python("import no_such_package"),
        python("raise MemoryError('CUDA out of memory. Tried 9 GiB')", "large"),
        python(says("fine"), "absent", missing="not installed: ncu"),
    )
    assert run.status() == (SKIPPED, "not installed: no_such_package")
    assert run.status("large")[0] == SKIPPED
    assert run.status("absent") == (SKIPPED, "not installed: ncu")


def test_work_in_the_background_runs_beside_the_others(tmp_path):
    flag = tmp_path / "flag"
    waits = f"import pathlib, time\nwhile not pathlib.Path({str(flag)!r}).exists(): time.sleep(0.01)\n"
    touches = f"import pathlib; pathlib.Path({str(flag)!r}).touch(); "
    run = Run(tmp_path)
    # The first one ends only if the second one runs at the same time.
    assert run(
        python(waits + says("done"), "waits", in_background=True), python(touches + says("touched"), "sets")
    )
    assert run.status("waits") == (PASSED, "done")
    assert run.status("sets") == (PASSED, "touched")


def test_no_test_of_gsplat_runs_while_gsplat_is_built(tmp_path):
    """The first use of gsplat deletes a build that another process has begun."""
    for piece in plan(setup(tmp_path), CHECKS):
        if "pytest" in piece.command:
            assert {f"--ignore={path}" for path in pieces.GSPLAT_TESTS} <= set(piece.command), piece.name
    assert all((REPOSITORY / path).is_file() for path in pieces.GSPLAT_TESTS)

    def after(result):
        record = new_record()
        record.pieces["gsplat"] = Entry(CHECKS, PASSED, "", 1.0, "", result=result)
        return next(p for p in plan(setup(tmp_path, record=record), EXPLAINS) if p.name == "tests of gsplat")

    assert after(None).missing == "gsplat is not built"
    assert after({"is_built": True}).missing is None
    assert set(pieces.GSPLAT_TESTS) < set(after(None).command)


def test_parts_take_at_most_25_minutes_and_each_less_than_ten(tmp_path):
    before, after = session.FACTS_SECONDS, session.STAGES_SECONDS
    assert sum(PARTS.values()) + before + after <= 25 * 60
    assert max(PARTS.values()) + before + after < 600
    for part, seconds in PARTS.items():
        assert all(piece.seconds <= seconds for piece in plan(setup(tmp_path), part))


def test_every_script_and_every_work_of_a_piece_exists(tmp_path):
    from gpu_run.on_device import WORK

    for part in PARTS:
        for piece in plan(setup(tmp_path), part):
            scripts = [word.removeprefix("--ignore=") for word in piece.command if word.endswith(".py")]
            assert all((REPOSITORY / script).is_file() for script in scripts), piece
            if "gpu_run.on_device" in piece.command:
                assert piece.command[piece.command.index("gpu_run.on_device") + 1] in WORK


def test_a_bare_machine_skips_what_it_lacks(tmp_path):
    bare = setup(tmp_path, tools={}, packages={"torch": "2.9", "pytest": "8"}, memory_bytes=8 * 2**30)
    missing = {piece.name: piece.missing for part in PARTS for piece in plan(bare, part) if piece.missing}
    assert missing["memcheck"] == missing["racecheck"] == "not installed: compute-sanitizer"
    assert missing["gsplat"] == "not installed: gsplat, nvcc, ninja"
    assert missing["ncu"] == "not installed: ncu"
    gates = [piece for piece in plan(bare, CHECKS) if piece.is_gate]
    assert [piece.name for piece in gates if not piece.missing] == [
        "self-test",
        "tests",
        "difficult scenes and the long sort",
    ]
    assert "-n" not in gates[1].command
    assert any("callback=" in word for piece in plan(bare, CHECKS) for word in piece.command)


def test_gsplat_is_timed_only_where_it_is_built(tmp_path):
    def backends(result):
        record = new_record()
        record.pieces["gsplat"] = Entry(CHECKS, FAILED, "", 1.0, "", result=result)
        command = plan(setup(tmp_path, record=record), TIMES)[1].command
        return command[command.index("--backends") + 1 : command.index("--counts")]

    assert backends({"is_built": True}) == ("gsplat", "cuda")
    assert backends(None) == ("cuda",)


def test_the_lines_of_benchmarks_are_accepted(tmp_path):
    import bench_rasterizer

    for part in PARTS:
        for piece in plan(setup(tmp_path), part):
            words = [word.replace(RESULT, "found.json") for word in piece.command[2:]]
            if "bench_rasterizer" in piece.command[1]:
                assert bench_rasterizer.parse(words).device == "cuda"
            elif "bench_" in piece.command[1]:
                source = Path(piece.command[1]).read_text()
                assert all(f'"{word}"' in source for word in words if word.startswith("--"))


# -------------------------------------------------------------------------- verdicts


@pytest.mark.parametrize(
    ("judge", "finished", "verdict"),
    [
        (pieces.by_pytest, Finished(0, "..\n== 201 passed, 3 skipped in 60.1s =="), PASSED),
        (pieces.by_pytest, Finished(0, "201 skipped, 994 deselected in 1.20s"), FAILED),
        (pieces.by_pytest, Finished(1, "FAILED tests/a.py::test_b - x\n1 failed, 3 passed in 1s"), FAILED),
        (pieces.by_sanitizer, Finished(0, "agrees\n========= ERROR SUMMARY: 0 errors"), PASSED),
        (pieces.by_sanitizer, Finished(1, "========= ERROR SUMMARY: 3 errors"), FAILED),
        (
            pieces.by_sanitizer,
            Finished(0, "========= RACECHECK SUMMARY: 0 hazards displayed (0 errors, 0 warnings)"),
            PASSED,
        ),
        (
            pieces.by_sanitizer,
            Finished(0, "========= RACECHECK SUMMARY: 2 hazards displayed (2 errors, 0 warnings)"),
            FAILED,
        ),
        (
            pieces.by_sanitizer,
            Finished(1, "========= Device not supported. Please refer to the docs"),
            SKIPPED,
        ),
        (pieces.by_check, Finished(0, "check cuda: agrees with the reference"), PASSED),
        (pieces.by_check, Finished(1, "check cuda: FAILED, not timed\n  needles: an image"), FAILED),
        (pieces.by_rows, Finished(0, "", {"rows": [{}, {}]}), PASSED),
        (pieces.by_rows, Finished(1, "Error", {"rows": [{}]}), FAILED),
        (pieces.by_steps, Finished(0, "", {"here": [{"prior": "exact", "wall_ms": 1.0}]}), PASSED),
        (pieces.by_steps, Finished(1, "error"), FAILED),
        (pieces.by_recipes, Finished(1, "Traceback\nKeyError: 3"), FAILED),
        (runner.by_result, Finished(0, "", {"says": "fine"}), PASSED),
        (runner.by_result, Finished(0, "", {"says": "no counters", "skipped": True}), SKIPPED),
        (runner.by_result, Finished(-11, "Segmentation fault"), FAILED),
    ],
)
def test_a_piece_is_judged_by_what_it_prints(judge, finished, verdict):
    status, line = judge(finished)
    assert status == verdict
    assert line
    assert "\n" not in line


def test_counters_are_those_of_the_longest_launch_of_a_kernel():
    from gpu_run.on_device import read_counters

    text = (
        '==PROF== Connected\n"ID","Kernel Name","Metric Name","Metric Unit","Metric Value"\n'
        '"0","sort_count(unsigned int)","Duration","us","8.1"\n'
        '"1","sort_count(unsigned int)","Duration","ms","1.2"\n'
        '"1","sort_count(unsigned int)","Registers Per Thread","register/thread","40"\n'
        '"1","sort_count(unsigned int)","Something else","","1"\n'
    )
    [found] = read_counters(text)
    assert found == {
        "kernel": "sort_count",
        "metrics": {"Duration": "1.2 ms", "Registers Per Thread": "40 register/thread"},
    }
    assert read_counters("==ERROR== ERR_NVGPUCTRPERM") == []


# -------------------------------------------------------------------------- the record and the report


ROW = {
    "count": 20_000,
    "size": 512,
    "views": 1,
    "degree": 0,
    "forward_ms": 0.2,
    "backward_ms": 0.3,
    "host_ms": 0.4,
    "peak_bytes": 3_000_000,
}


def whole_record() -> Record:
    """Return a record with a result of every kind."""
    record = new_record()
    rows = [
        ROW | {"backend": "gsplat", "step_ms": 0.9},
        ROW | {"backend": "cuda", "step_ms": 0.45},
    ]
    stages = [{"stage": "project", "launches": 2, "median_ms": 0.1, "bytes": 10**6, "floor_ms": 0.02}]
    stages += [{"stage": "rest", "launches": 0, "median_ms": 0.1, "bytes": None, "floor_ms": None}]
    found = {
        "self-test": {"says": "agrees"},
        "choice of auto": {"says": "uses gsplat", "backend": "gsplat"},
        "times": {"rows": rows},
        "kernels": {"scenes": [ROW | {"wall_ms": 0.5, "kernel_ms": 0.4, "stages": stages}]},
        "sorts": {"sorts": [{"keys": 80_000, "bits": 32, "ours_ms": 0.1, "torch_ms": 0.2}]},
        "ncu": {"counters": [{"kernel": "blend_forward", "metrics": {"Duration": "1 ms"}}]},
        "step": {
            "here": [
                {
                    "prior": "exact",
                    "gaussians": 4000.0,
                    "wall_ms": 9.0,
                    "parts_ms": {"rest": 1.0, "render": 2.0},
                }
            ]
        },
        "recipes": {
            "results": [
                {
                    "recipe": "luciddreamer",
                    "vram": "low",
                    "seconds_per_step": 0.2,
                    "stages": {"render": 0.1},
                    "peak_bytes": 3 * 2**30,
                    "estimate_bytes": 3 * 2**30,
                }
            ]
        },
    }
    for name, result in found.items():
        record.pieces[name] = Entry(CHECKS, PASSED, "fine", 1.0, "2026-01-02", result=result)
    record.pieces["hangs | long"] = Entry(EXPLAINS, ENDED, "still running", 60.0, "2026-01-02")
    return record


def test_the_json_becomes_the_same_markdown_again(tmp_path, capsys):
    record, path = whole_record(), tmp_path / "gpu.json"
    record.write(path)
    assert read_record(path) == record
    assert gpu.main(["--markdown", str(path)]) == 0
    assert capsys.readouterr().out == markdown.show(record)


def test_the_markdown_has_one_table_with_every_result():
    text = markdown.show(whole_record())
    table = [line for line in text.splitlines() if line.startswith("|")]
    # One header, and a line that separates it.
    assert len([line for line in table if set(line) <= set("|- ")]) == 1
    assert all(len(re.findall(r"(?<!\\)\|", line)) == 4 for line in table)
    for word in (
        "0.45 (host 0.40, forward 0.20, backward 0.30); 3 MB",
        "the GPU is busy 80% of the time",
        "0.100 in 2 launches; 5.0x the time of its 1.0 MB",
        "80,000 keys of 32 bits | 0.100, 0.200: 2.00x",
        "counters of blend_forward",
        "step, exact prior | 4,000 Gaussians | 9.00; parts render 2.00, rest 1.00",
        "200 per step (render 100); peak 3.0 GiB, estimated 3.0",
        "**ended by its time limit**: still running",
        "cuda of gsplat, cuda; auto uses gsplat, **which is slower**",
        "commit 0123456789 with changes",
    ):
        assert word in text, word


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"machine": {}, "state": "", "pieces": {"a": {}}}'])
def test_a_file_that_is_no_record_is_refused_in_one_line(content, tmp_path, capsys):
    path = tmp_path / "gpu.json"
    path.write_text(content)
    assert gpu.main(["--markdown", str(path)]) == 1
    error = capsys.readouterr().err
    assert "is not a record of this script" in error
    assert error.count("\n") == 1


# -------------------------------------------------------------------------- sessions


@pytest.fixture
def started(tmp_path, monkeypatch):
    """Return a function that runs parts with small pieces, as on a machine with a GPU."""
    monkeypatch.setenv("PYTHONPATH", "")

    def small(setup, part):
        flag = Path(setup.folder) / "broken"
        gate = f"import pathlib, sys; sys.exit(pathlib.Path({str(flag)!r}).exists())"
        judge = pieces.by_last_line(".*")
        return {
            CHECKS: [python(gate, "self-test", is_gate=True, judge=judge)],
            TIMES: [python(says("timed"), "times", TIMES)],
            EXPLAINS: [python(says("explained"), "kernels", EXPLAINS)],
        }[part]

    def run(*parts, **changes):
        shown = []
        found = session.Session(tmp_path, DEVICE, shown.append)
        monkeypatch.setattr(found, "_machine", lambda: MACHINE | changes)
        try:
            return found.run(parts or list(PARTS)), shown
        except session.TroubleError as error:
            return str(error), shown

    monkeypatch.setattr(session, "plan", small)
    # The comparison with the emulator needs a GPU.
    monkeypatch.setattr(Setup, "own", lambda self, name, *_: (sys.executable, "-c", says("stage"), RESULT))
    return run


def test_a_run_can_be_made_in_three_parts(started, tmp_path):
    for part in PARTS:
        assert started(part)[0] == 0
    record = read_record(tmp_path / "gpu.json")
    assert list(record.pieces) == ["self-test", "times", "kernels"]
    assert (tmp_path / "gpu.md").read_text() == markdown.show(record)


def test_a_failed_check_stops_the_run_and_names_the_stage(started, tmp_path):
    (tmp_path / "broken").touch()
    code, shown = started()
    assert code == 1
    record = read_record(tmp_path / "gpu.json")
    assert list(record.pieces) == ["self-test", "stages"]
    assert record.pieces["stages"].says == "stage"
    assert any("nothing is timed" in line for line in shown)


@pytest.mark.skipif(session.fcntl is None, reason="the system has no such locks")
def test_two_runs_do_not_share_a_folder(started, tmp_path):
    with session.alone(tmp_path):
        message, _ = started(CHECKS)
    assert message.startswith(f"another run uses {tmp_path}")
    assert not (tmp_path / "gpu.json").exists()
    assert started(CHECKS)[0] == 0, "the end of the other run frees the folder"


def test_another_driver_starts_over_and_keeps_the_old_results(started, tmp_path):
    started()
    _, shown = started(CHECKS, driver="560.2")
    assert any("has changed" in line for line in shown)
    assert list(read_record(tmp_path / "gpu.json").pieces) == ["self-test"]
    [old] = tmp_path.glob("gpu-*.json")
    assert len(read_record(old).pieces) == 3


def test_facts_are_json(tmp_path):
    from gpu_run import on_device

    path = tmp_path / "facts.json"
    on_device.main(["facts", "--json", str(path)])
    assert json.loads(path.read_text())["torch"]
