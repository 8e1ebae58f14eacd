"""The first run on a GPU, with the emulator in place of the driver: checks, times, stages and verdicts."""

import json
import os
import sys
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))  # as Python does for a script

import bench_rasterizer
from emulation import Emulator, load_emulator
from gpu_run import bisect, on_device, session
from gpu_run.machine import Device
from gpu_run.pieces import CHECKS, PARTS, Setup
from gpu_run.record import FAILED, PASSED, SKIPPED, read_record
from gpu_run.runner import Finished, Processes
from mutants import MUTANTS, NUMBERS, plant
from rasterizer_bench import check
from rasterizer_bench.scenes import make_scene, make_shell
from rasterizer_bench.stages import KernelRasterizer

CPU = torch.device("cpu")
PLANTED = "two sums are swapped"
TINY = ["--counts", "30", "--sizes", "16", "--views", "2", "--degrees", "0", "--repeats", "1"]


class Forks(Processes):
    """Runs each piece in a fork of this process, which has imported torch already."""

    def __init__(self, folder: Path, work: Callable[[list[str]], int]) -> None:
        self.folder, self.work = folder, work

    def start(self, piece):
        self.folder.mkdir(exist_ok=True)
        log, result = self.folder / "log", self.folder / f"{piece.name}.json"
        words = [word.replace("{result}", str(result)) for word in piece.command]

        def child():
            torch.set_num_threads(1)  # threads do not survive a fork
            with log.open("w") as sink, redirect_stdout(sink):
                code = self.work(words)
            os._exit(code)

        process = get_context("fork").Process(target=child)
        process.start()
        return SimpleNamespace(piece=piece, process=process, log=log, result=result, began=0.0)

    def wait(self, job, seconds):
        job.process.join(60)
        result = None
        with suppress(OSError):
            result = json.loads(job.result.read_text())
        return Finished(job.process.exitcode, job.log.read_text(), result)


def work_on(kernels: Emulator, truth: Emulator, words: list[str]) -> int:
    """Do the work of a piece as a process on a GPU does, with small scenes."""
    check.SPLATS, check.SIZE, check.REPEATED, check.RUNS = 24, 16, {"cpu": (24, 16)}, 2
    bench_rasterizer.make_backends = lambda *_: {"cuda": KernelRasterizer(kernels)}
    bench_rasterizer.load_kernels = lambda _: kernels
    bench_rasterizer.LONG_SORT = 2000
    facts = {"device": "Fibers", "capability": "0.0", "memory_bytes": 2**30, "nvrtc": None}
    on_device.WORK |= {
        "facts": lambda: facts | {"torch": torch.__version__, "torch_cuda": None},
        "self-test": lambda: on_device.compare(KernelRasterizer(kernels), "cpu"),
        "stages": lambda: bisect.find_stage(kernels, CPU, truth),
        "auto": lambda: {"says": "uses cuda", "backend": "cuda"},
        "kernels": lambda: on_device.explain(kernels, CPU, ((30, 16, 2, 0),), 1, 2**20),
        "sorts": lambda: on_device.compare_sorts(kernels, CPU, ((500, 32), (500, 9)), 1),
    }
    name, *rest = words
    if name != "bench_rasterizer":
        return on_device.main(words)
    rest[rest.index("cuda")] = "cpu"
    if "--no-check" in rest:
        rest[rest.index("--counts") : rest.index("--no-check")] = TINY
    return bench_rasterizer.main(rest)


@pytest.fixture(scope="session")
def mutant(build_cache, tmp_path_factory) -> Emulator:
    """Return kernels with one mistake, for all degrees, because the self-test has degree 1."""
    folder = tmp_path_factory.mktemp("mutant")
    return load_emulator(build_cache, plant({PLANTED: MUTANTS[PLANTED]}, folder, only_degree_0=False), "-O0")


@pytest.fixture
def whole_run(emulator, tmp_path, monkeypatch):
    """Return a function that runs everything with some kernels, and returns the exit code and the record."""
    monkeypatch.setenv("PYTHONPATH", "")
    plan = session.plan
    others = ("demo", "step", "times of 3.4 M", "times of SH 3")

    def without(setup, part):
        return [piece for piece in plan(setup, part) if piece.name not in others]

    def run(kernels: Emulator):
        forks = Forks(tmp_path / "logs", lambda words: work_on(kernels, emulator, words))
        monkeypatch.setattr(session, "Processes", lambda *_: forks)
        monkeypatch.setattr(Setup, "own", lambda _, name, *__: (name, "--json", "{result}"))
        monkeypatch.setattr(Setup, "script", lambda _, name, *words: (name, *words))
        monkeypatch.setattr(session, "FACTS", ("facts", "--json", "{result}"))
        monkeypatch.setattr(session, "find_tools", dict)
        monkeypatch.setattr(session, "find_packages", lambda: {"torch": torch.__version__})
        monkeypatch.setattr(session, "plan", without)
        device = Device("Fibers", "0.0", 2**30, 1, "13.0", 1)
        shown: list[str] = []
        code = session.Session(tmp_path, device, shown.append).run(list(PARTS))
        return code, read_record(tmp_path / "gpu.json"), shown

    return run


def test_right_kernels_are_checked_timed_and_explained(whole_run, emulator, tmp_path):
    code, record, shown = whole_run(emulator)
    statuses = {name: entry.status for name, entry in record.pieces.items()}
    assert code == 0, shown
    assert set(statuses.values()) == {PASSED, SKIPPED}
    assert {name for name, status in statuses.items() if status == PASSED} == {
        "self-test",
        "difficult scenes and the long sort",
        "choice of auto",
        "times",
        "kernels",
        "sorts",
    }
    text = (tmp_path / "gpu.md").read_text()
    for stage in ("project", "depth sort", "blend backward", "rest"):
        assert f"stage {stage}" in text
    assert "fastest, and choice of `auto`" in text


def test_a_wrong_kernel_stops_the_run_and_its_stage_is_named(whole_run, mutant):
    mutant.activate(1)
    code, record, _ = whole_run(mutant)
    assert code == 1
    assert record.pieces["self-test"].status == FAILED
    assert {entry.part for entry in record.pieces.values()} == {CHECKS}
    assert record.pieces["stages"].result["stage"] == "blend backward"
    assert "records is wrong by" in record.pieces["stages"].says


# -------------------------------------------------------------------------- stages


STAGES = {
    "the last row of tiles is forgotten": "project",  # counts tiles with the same function as the lists
    "lists that disagree with their counts": "tile lists",
    "a list that misses its last splat": "tile sort",
    "a pixel that never closes": "blend forward",
    "two sums are swapped": "blend backward",
    "absolute values that cancel": "blend backward",
    "half of a long run": "project backward",
}


@pytest.mark.parametrize("name", STAGES)
def test_the_stage_of_a_planted_mistake_is_named(name, mutants, emulator, monkeypatch):
    plain = make_shell(60, 0, CPU)
    large = {"log_scales": plain.log_scales + 1.5, "opacity_logits": plain.opacity_logits + 4.0}
    wide = type(plain)(**plain.tensors() | large)
    monkeypatch.setattr(bisect, "scenes", lambda: [(make_scene(wide, 88, 1), 0.0)])
    mutants.activate(NUMBERS[name])
    try:
        found = bisect.find_stage(mutants, CPU, emulator)
    finally:
        mutants.activate(0)
    assert found["stage"] == STAGES[name], found
