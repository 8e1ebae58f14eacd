"""The results of the benchmark, as a table to read and as JSON for programs."""

import json
import platform
import subprocess
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from rasterizer_bench.stages import StageTiming
from rasterizer_bench.targets import demanded_ms, demanded_ratio
from rasterizer_bench.timing import Timing

import cadam3d

REPOSITORY = Path(__file__).parents[2]
HEADER = (
    f"{'N':>9} {'pixels':>6} {'views':>5} {'SH':>2} {'backend':>10} {'forward':>9} {'backward':>9} "
    f"{'both':>9} {'step':>9} {'host':>9} {'best':>9} {'ratio':>7} {'memory':>8}  target"
)


@dataclass(frozen=True)
class Row:
    """The times of one backend on one scene, in milliseconds; ``None`` if it ran out of memory."""

    count: int
    size: int
    views: int
    degree: int
    backend: str
    forward_ms: float | None = None
    backward_ms: float | None = None
    forward_backward_ms: float | None = None
    step_ms: float | None = None  # forward and backward as a training step calls them
    host_ms: float | None = None  # of these, until the calls have returned
    forward_backward_min_ms: float | None = None
    ratio: float | None = None  # ``step_ms`` of the first backend divided by this one's
    peak_bytes: int | None = None
    demanded_ms: float | None = None
    demanded_ratio: float | None = None  # gsplat's time divided by this one's
    is_met: bool | None = None  # whether both targets are met; None without a target to compare with

    def __str__(self) -> str:
        scene = f"{self.count:>9} {self.size:>6} {self.views:>5} {self.degree:>2} {self.backend:>10}"
        if self.forward_backward_ms is None:
            return f"{scene}   out of memory"
        times = (self.forward_ms, self.backward_ms, self.forward_backward_ms)
        times += (self.step_ms, self.host_ms, self.forward_backward_min_ms)
        ratio = "" if self.ratio is None else f"{self.ratio:.2f}x"
        memory = "" if self.peak_bytes is None else f"{self.peak_bytes / 2**20:.0f} MB"
        cells = "".join(f" {time:>9.2f}" for time in times) + f" {ratio:>7} {memory:>8}"
        return f"{scene}{cells}  {self._verdict()}".rstrip()

    def _verdict(self) -> str:
        if self.is_met is None:
            return ""
        wanted = [f"<= {self.demanded_ms:g} ms"] if self.demanded_ms is not None else []
        wanted += [f">= {self.demanded_ratio:g}x gsplat"] if self.demanded_ratio is not None else []
        return f"{', '.join(wanted)}: {'met' if self.is_met else 'MISSED'}"


def make_rows(
    scene: tuple[int, int, int, int], timings: dict[str, Timing | None], device_name: str
) -> list[Row]:
    """Return the rows of one scene (count, size, views, degree), in the order of ``timings``."""
    steps = {name: timing.median_ms["step"] if timing else None for name, timing in timings.items()}
    first = next(iter(steps.values()))
    rows = []
    for name, timing in timings.items():
        if timing is None:
            rows.append(Row(*scene, name))
            continue
        ratio = first / steps[name] if first is not None else None
        demands = judge(scene, steps, device_name) if name == "cuda" else (None, None, None)
        times = (*timing.median_ms.values(), timing.min_ms["forward_backward"])
        rows.append(Row(*scene, name, *times, ratio, timing.peak_bytes, *demands))
    return rows


def judge(
    scene: tuple[int, int, int, int], steps: dict[str, float | None], device_name: str
) -> tuple[float | None, float | None, bool | None]:
    """Return the targets of ``cuda``, in milliseconds and as a ratio to gsplat, and whether they are met."""
    count, _, views, _ = scene
    most_ms, least_ratio = demanded_ms(device_name, *scene), demanded_ratio(count, views)
    ours, gsplat = steps["cuda"], steps.get("gsplat")
    if gsplat is None:
        least_ratio = None
    verdicts = [ours <= most_ms] if most_ms is not None else []
    verdicts += [gsplat / ours >= least_ratio] if least_ratio is not None else []
    return most_ms, least_ratio, all(verdicts) if verdicts else None


def show_stages(stages: list[StageTiming]) -> str:
    """Return a table of the stages of one scene."""
    lines = [f"{'':>9} {'stage':>17} {'launches':>8} {'ms':>8} {'MB':>8} {'floor ms':>9} {'of floor':>8}"]
    for stage in stages:
        line = f"{'':>9} {stage.stage:>17} {stage.launches:>8} {stage.median_ms:>8.3f}"
        if stage.floor_ms is not None:
            line += f" {stage.bytes / 1e6:>8.1f} {stage.floor_ms:>9.3f}"
            line += f" {stage.median_ms / stage.floor_ms:>7.1f}x" if stage.floor_ms > 0 else ""
        lines.append(line)
    return "\n".join(lines)


@dataclass(frozen=True)
class SceneStages:
    """The stages of ``cuda`` on one scene."""

    count: int
    size: int
    views: int
    degree: int
    wall_ms: float
    kernel_ms: float
    stages: list[StageTiming]


@dataclass
class Report:
    """The content of the JSON file."""

    device: dict[str, object]
    versions: dict[str, str | None]
    commit: str | None
    settings: dict[str, object]
    copy_bytes_per_ms: float | None = None  # read and written; determines the floors of the stages
    rows: list[Row] = field(default_factory=list)
    stages: list[SceneStages] = field(default_factory=list)

    def write(self, path: Path) -> None:
        """Write the report as JSON."""
        path.write_text(json.dumps(asdict(self), indent=2) + "\n", encoding="utf-8")


def start_report(device: torch.device, settings: dict[str, object]) -> Report:
    """Return a report without results, with the device, the versions and the settings."""
    return Report(describe(device), versions(), commit(), settings)


def describe(device: torch.device) -> dict[str, object]:
    """Return the facts about a device that affect its times."""
    if device.type != "cuda":
        return {"name": processor(), "driver": None, "threads": torch.get_num_threads()}
    facts = torch.cuda.get_device_properties(device)
    return {
        "name": facts.name,
        "driver": _first_line("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"),
        "capability": f"{facts.major}.{facts.minor}",
        "memory_bytes": facts.total_memory,
        "processor": processor(),
    }


def processor() -> str:
    """Return the name of the CPU, as far as the system reports it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    found = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return found[0] if found else platform.processor() or platform.machine()


def versions() -> dict[str, str | None]:
    """Return the versions of everything that affects the times; ``None`` for what is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        gsplat = version("gsplat")
    except PackageNotFoundError:
        gsplat = None
    return {
        "cadam3d": cadam3d.__version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
        "gsplat": gsplat,
        "system": platform.platform(),
    }


def commit() -> str | None:
    """Return the current commit, marked if files differ from it; ``None`` outside a checkout."""
    found = _first_line("git", "-C", str(REPOSITORY), "rev-parse", "HEAD")
    changed = _first_line("git", "-C", str(REPOSITORY), "status", "--porcelain", "--untracked-files=no")
    return f"{found} with changes" if found and changed else found


def _first_line(*command: str) -> str | None:
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip().splitlines()[0] if answer.stdout.strip() else None
