"""``cadam3d doctor``: what this machine has, and what to type about each thing that it lacks."""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from enum import StrEnum
from importlib import import_module, metadata
from pathlib import Path

from omegaconf import DictConfig

from cadam3d import __version__
from cadam3d.core.errors import UserError
from cadam3d.settings import component, compose, config_dir

PACKAGES = ("torch", "numpy", "hydra-core", "omegaconf", "imageio", "imageio-ffmpeg", "jaxtyping", "kornia")
PACKAGES += ("pillow", "pyyaml", "scipy", "tqdm", "trimesh")
IMPORT_NAMES = {"hydra-core": "hydra", "imageio-ffmpeg": "imageio_ffmpeg", "pillow": "PIL", "pyyaml": "yaml"}
COMPILERS = ("c++", "g++", "clang++", "nvcc")
SECONDS = 60  # longest wait for a program that we ask for its version


class Verdict(StrEnum):
    """What a finding means for training."""

    OK = "ok"
    NOTE = "note"  # absent, and not needed by default
    BROKEN = "broken"


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    topic: str
    verdict: Verdict
    found: str
    hint: str = ""  # what to type, unless all is well


def run(cfg: DictConfig) -> None:
    """Print every finding; exit with 1 if one of them is broken."""
    findings = list(examine())
    broken = [finding for finding in findings if finding.verdict is Verdict.BROKEN]
    if cfg.json:
        print(json.dumps({"ok": not broken, "findings": [asdict(finding) for finding in findings]}, indent=2))
    else:
        for finding in findings:
            print(f"{finding.verdict:<7} {finding.topic:<22} {finding.found}")
            if finding.hint:
                print(f"{'':<31}{finding.hint}")
        print(f"\n{len(broken)} broken" if broken else "\nReady to train.")
    if broken:
        sys.exit(1)


def examine() -> Iterator[Finding]:
    """Look at everything; no check may stop the ones after it."""
    yield _python()
    yield from map(_package, PACKAGES)
    for check in (_torchvision, _device, _ffmpeg, _configs):
        yield _guarded(check)
    yield from map(_compiler, COMPILERS)
    yield from _components("rasterizer", _try_rasterizer)
    yield from _components("prior", _try_prior)
    yield from map(_guarded, (_diffusers, _models))


def _guarded(check: Callable[[], Finding]) -> Finding:
    """A check that itself fails has found something broken."""
    try:
        return check()
    except Exception as error:
        topic = check.__name__.strip("_")
        return Finding(
            topic, Verdict.BROKEN, f"{type(error).__name__}: {error}", "Try: pip install --upgrade ."
        )


def _python() -> Finding:
    version = platform.python_version()
    found = f"{version} on {platform.system()} {platform.machine()}, cadam3d {__version__}"
    if (3, 11) <= sys.version_info[:2] <= (3, 13):
        return Finding("python", Verdict.OK, found)
    return Finding(
        "python", Verdict.BROKEN, found, "Wanted 3.11 to 3.13. Try: make clean demo PYTHON=python3.12"
    )


def _package(name: str) -> Finding:
    try:
        import_module(IMPORT_NAMES.get(name, name))
        return Finding(name, Verdict.OK, metadata.version(name))
    except Exception as error:  # a package may fail to import in any way
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        return Finding(name, Verdict.BROKEN, reason, f"Try: pip install --force-reinstall {name}")


def _torchvision() -> Finding:
    """One that does not fit torch breaks every package that uses it as soon as it sees it, diffusers too."""
    try:
        version = metadata.version("torchvision")
    except metadata.PackageNotFoundError:
        return Finding("torchvision", Verdict.OK, "not installed, not needed")
    code, output = _ask([sys.executable, "-c", "import torchvision"])
    if code == 0:
        return Finding("torchvision", Verdict.OK, version)
    reason = output.strip().splitlines()[-1] if output.strip() else "does not import"
    return Finding(
        "torchvision",
        Verdict.BROKEN,
        f"{version} does not fit torch: {reason}",
        "Try: pip uninstall torchvision",
    )


def _device() -> Finding:
    import torch

    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(0)
        memory = properties.total_memory / 2**30
        return Finding(
            "device", Verdict.OK, f"{properties.name}, {memory:.0f} GiB, CUDA {torch.version.cuda}"
        )
    found = f"CPU, {torch.get_num_threads()} threads"
    if shutil.which("nvidia-smi") and _ask(["nvidia-smi", "-L"])[0] == 0:
        built = f"torch is built for CUDA {torch.version.cuda}" if torch.version.cuda else "torch is CPU-only"
        hint = "Try: pip install --force-reinstall torch, with the CUDA version of your driver"
        return Finding("device", Verdict.NOTE, f"{found}; there is a GPU, but {built}", hint)
    return Finding("device", Verdict.OK, found)


def _ffmpeg() -> Finding:
    import imageio_ffmpeg

    path = imageio_ffmpeg.get_ffmpeg_exe()
    code, output = _ask([path, "-version"])
    version = re.search(r"version (\S+)", output)
    if code == 0 and version:
        return Finding("ffmpeg", Verdict.OK, f"{version.group(1)}, {path}")
    hint = "Try: pip install --force-reinstall imageio-ffmpeg"
    return Finding("ffmpeg", Verdict.BROKEN, f"{path} does not run", hint)


def _configs() -> Finding:
    folder = config_dir()
    cfg = compose(["prompt=test"])
    return Finding("configs", Verdict.OK, f"{folder}, {len(cfg)} settings and groups")


def _compiler(name: str) -> Finding:
    path = shutil.which(name)
    if path is None:
        return Finding(name, Verdict.NOTE, "not found; only native kernels would need it")
    code, output = _ask([path, "--version"])
    if code != 0:
        return Finding(name, Verdict.NOTE, f"{path} does not run")
    lines = output.strip().splitlines() or [path]
    release = [line for line in lines if "release" in line]  # nvcc says it on its fourth line
    return Finding(name, Verdict.OK, (release or lines)[0].strip())


def _components(group: str, attempt: Callable[[str, DictConfig], str]) -> Iterator[Finding]:
    """Try every option of a group as a user would get it."""
    for path in sorted((config_dir() / group).glob("*.yaml")):
        topic = f"{group}={path.stem}"
        try:
            found = attempt(path.stem, compose(["prompt=test", topic])[group])
            yield Finding(topic, Verdict.OK, found)
        except (UserError, ImportError, OSError) as error:  # not available here, and it says why
            yield Finding(topic, Verdict.NOTE, str(error).splitlines()[0])
        except Exception as error:
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            yield Finding(topic, Verdict.BROKEN, reason, "Try: pip install --force-reinstall cadam3d")


def _try_rasterizer(name: str, node: DictConfig) -> str:
    """Render one Gaussian from one view, where training would: on the device, or with ``cpu`` on the CPU."""
    import torch

    from cadam3d.core.cameras import turntable
    from cadam3d.core.gaussians import Gaussians
    from cadam3d.rasterizer.base import Rasterizer
    from cadam3d.trainer import resolve_device

    rasterizer: Rasterizer = component(node)
    device = resolve_device("auto")
    chosen = rasterizer.chosen(device)
    gaussians = Gaussians(
        means=torch.zeros(1, 3),
        log_scales=torch.full((1, 3), -1.0),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacity_logits=torch.full((1,), 4.0),
        sh=torch.zeros(1, 1, 3),
    ).to("cpu" if chosen == "cpu" else device)
    camera = turntable(1, elevation_deg=0.0, distance=3.0, fov_y_deg=40.0, size=16)
    with torch.no_grad():
        alpha = float(rasterizer.render(gaussians, camera, torch.zeros(1, 3)).alpha[0, 8, 8])
    if not 0.9 < alpha < 1:
        raise RuntimeError(f"rendered alpha {alpha:.3f} where it should be 0.98")
    if name == "cpu":
        return f"renders, {_kernels(node.cache_dir)}"
    return "renders" if chosen == name else f"renders with {chosen}"


def _kernels(cache_dir: str | None) -> str:
    """What the native kernels are compiled for, and where they are kept."""
    from cadam3d.rasterizer.build import default_cache_dir
    from cadam3d.rasterizer.cpu import instruction_set, load_kernels

    return f"{instruction_set(load_kernels(cache_dir))} kernels in {cache_dir or default_cache_dir()}"


def _try_prior(_: str, node: DictConfig) -> str:
    prior = component(node)
    return (prior.notice() or "ready").splitlines()[0]


def _diffusers() -> Finding:
    try:
        return Finding("diffusers", Verdict.OK, metadata.version("diffusers"))
    except metadata.PackageNotFoundError:
        return Finding(
            "diffusers", Verdict.NOTE, "not installed; only priors with downloaded weights need it"
        )


def _models() -> Finding:
    """Models in the cache of the Hugging Face hub, by name; nothing is loaded."""
    home = Path(os.environ.get("HF_HOME") or Path("~/.cache/huggingface").expanduser())
    cache = Path(os.environ.get("HF_HUB_CACHE") or home / "hub")
    names = sorted(path.name.removeprefix("models--").replace("--", "/") for path in cache.glob("models--*"))
    if not names:
        return Finding("models on disk", Verdict.NOTE, f"none in {cache}; prior=shapes needs none")
    return Finding("models on disk", Verdict.OK, ", ".join(names))


def _ask(command: list[str]) -> tuple[int, str]:
    """Exit code and output of a program; 127 if it cannot be run or does not answer."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return 127, str(error)
    return done.returncode, done.stdout + done.stderr
