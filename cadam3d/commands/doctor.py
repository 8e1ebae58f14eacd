"""``cadam3d doctor``: check this machine, and print what to type if something is missing or broken."""

import json
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from importlib import import_module, metadata

import imageio_ffmpeg
import torch
from omegaconf import DictConfig

from cadam3d import __version__
from cadam3d.build import component
from cadam3d.compiled import library
from cadam3d.core.console import show
from cadam3d.core.errors import UserError
from cadam3d.prior.shapes.native_tracer import load_tracer
from cadam3d.rasterizer import nvrtc
from cadam3d.rasterizer.auto import AutoRasterizer
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.rasterizer.cpu import CpuRasterizer
from cadam3d.rasterizer.cuda import CudaRasterizer
from cadam3d.rasterizer.gsplat import GsplatRasterizer
from cadam3d.rasterizer.reference import ReferenceRasterizer
from cadam3d.rasterizer.selftest import ATOMIC, GSPLAT, OWN, Demands, self_test
from cadam3d.settings.compose import Call, compose
from cadam3d.settings.options import config_dir, option_names

OK, NOTE, BROKEN = "ok", "note", "broken"  # a note: not available, and not needed by default
# The packages that are imported under another name.
IMPORT_NAMES = {"hydra-core": "hydra", "pillow": "PIL", "pyyaml": "yaml", "scikit-image": "skimage"}
CPU = torch.device("cpu")
ON_CPU = (("reference", ReferenceRasterizer(), OWN), ("cpu", CpuRasterizer(cache_dir=None), OWN))
ON_GPU = (
    ("reference", ReferenceRasterizer(), ATOMIC),
    ("cuda", CudaRasterizer(cache_dir=None), OWN),
    ("gsplat", GsplatRasterizer(), GSPLAT),
)
# Failures that do not end a training, because auto chooses another backend then.
REPLACED = ("cuda", "gsplat")
REPORT = "Please report this. Until it is fixed, use rasterizer=reference"
REINSTALL = "Try: pip install --force-reinstall {}"


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    topic: str
    verdict: str  # OK, NOTE or BROKEN
    found: str
    hint: str = ""  # what to type; empty if nothing is wrong


def run(cfg: DictConfig, _call: Call) -> None:
    """Print every finding; exit with 1 if one of them is broken."""
    findings = list(examine())
    broken = [finding for finding in findings if finding.verdict == BROKEN]
    if cfg.json:
        show(json.dumps({"ok": not broken, "findings": [asdict(finding) for finding in findings]}, indent=2))
    else:
        for finding in findings:
            show(f"{finding.verdict:<7} {finding.topic:<22} {finding.found}")
            if finding.hint:
                show(f"{'':<31}{finding.hint}")
        show(f"\n{len(broken)} broken" if broken else "\nReady to train.")
    if broken:
        sys.exit(1)


def examine() -> Iterator[Finding]:
    """Run all checks. A check that fails does not stop the following ones."""
    system = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    yield Finding("python", OK, f"{system}, cadam3d {__version__}")
    for name in dependencies():
        yield attempt(name, partial(check_package, name), REINSTALL.format(name))
    yield attempt("device", check_device)
    yield attempt("ffmpeg", check_ffmpeg, REINSTALL.format("imageio-ffmpeg"))
    yield attempt("configs", check_configs, REINSTALL.format("."))
    yield attempt("compilers", check_compilers)
    yield from check_rasterizers()
    yield attempt("prior.tracer=auto", check_tracer)
    yield from map(check_prior, option_names("prior"))


def attempt(topic: str, check: Callable[[], str], hint: str = "") -> Finding:
    """Return what ``check`` finds, or a finding about the error that it raises.

    The error is a note if something is not available that training does not need. Training needs what has a
    ``hint``, which says how to get it.
    """
    try:
        return Finding(topic, OK, check())
    except Exception as error:
        first, *others = str(error).splitlines() or [type(error).__name__]
        if isinstance(error, UserError | ImportError | OSError) and not hint:
            return Finding(topic, NOTE, first, *others[-1:])
        return Finding(topic, BROKEN, f"{type(error).__name__}: {first}", hint or REPORT)


def dependencies() -> list[str]:
    """Return the names of the packages that cadam3d needs without extras."""
    lines = [line for line in metadata.requires("cadam3d") or () if "extra ==" not in line]
    return [re.split(r"[^\w-]", line)[0] for line in lines]


def check_package(name: str) -> str:
    """Import a package and return its version."""
    import_module(IMPORT_NAMES.get(name, name.replace("-", "_")))
    return metadata.version(name)


def check_device() -> str:
    """Return the device that trains. Raises ``UserError`` if there is a GPU that torch cannot use."""
    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(0)
        memory = properties.total_memory / 2**30
        return f"{properties.name}, {memory:.0f} GiB, CUDA {torch.version.cuda}"
    found, command = f"CPU, {torch.get_num_threads()} threads", ["nvidia-smi", "-L"]
    if shutil.which(command[0]) and subprocess.run(command, capture_output=True, check=False).returncode == 0:
        hint = f"{REINSTALL.format('torch')}, with the CUDA version of your driver"
        raise UserError(f"{found}; torch cannot use the GPU\n{hint}")
    return found


def check_ffmpeg() -> str:
    """Run ffmpeg and return its version."""
    return f"{imageio_ffmpeg.get_ffmpeg_version()}, {imageio_ffmpeg.get_ffmpeg_exe()}"


def check_configs() -> str:
    """Compose the default settings and return how many there are."""
    return f"{config_dir()}, {len(compose(['prompt=test']))} settings and groups"


def check_compilers() -> str:
    """Return the compilers of the kernels: a C++ compiler, and NVRTC for a GPU."""
    native, nvidia = library.find_compiler(), nvrtc.find_compiler()
    found = [native.version] if native else []
    found += ["NVRTC {}.{}".format(*nvidia.version)] if nvidia else []
    if not found:
        raise UserError("none")
    return ", ".join(found)


def check_rasterizers() -> Iterator[Finding]:
    """Compile and test each backend on each device. ``auto`` is last because it would compile silently."""
    devices = [CPU, *(torch.device("cuda", i) for i in range(torch.cuda.device_count()))]
    for device in devices:
        for name, rasterizer, demands in ON_CPU if device == CPU else ON_GPU:
            check = partial(check_rasterizer, name, rasterizer, device, demands)
            yield attempt(f"rasterizer={name}", check)
    for device in devices:
        yield attempt("rasterizer=auto", partial(check_choice, device))


def check_rasterizer(name: str, rasterizer: Rasterizer, device: torch.device, demands: Demands) -> str:
    """Compile a backend and compare it with the reference.

    Raises ``UserError`` if training cannot use it and does not need it, and ``RuntimeError`` if it is wrong.
    """
    rasterizer.prepare(device)
    agreement = self_test(rasterizer, device, demands)
    found = f"{agreement}, on {device}"
    if agreement.passes:
        return found
    raise UserError(f"{found}\n{REPORT}") if name in REPLACED else RuntimeError(found)


def check_choice(device: torch.device) -> str:
    """Return the backend that ``auto`` chooses. Raises ``UserError`` if it is not the fastest."""
    backend = AutoRasterizer().prepare(device)
    chosen = f"chooses {backend.name} on {device}"
    if backend.reason is not None:
        raise UserError(f"{chosen}: {backend.reason}")
    return chosen


def check_tracer() -> str:
    """Compile the native tracer, which tests itself. Raises ``UserError`` if it is not available."""
    load_tracer()
    return "native"


def check_prior(name: str) -> Finding:
    """Build a prior without its weights, and say what it lacks."""

    def check() -> str:
        prior = component(compose(["prompt=test", f"prior={name}"]).prior)
        if (lack := prior.lacks()) is not None:
            raise UserError(lack)
        return (prior.notice() or "ready").splitlines()[0]

    return attempt(f"prior={name}", check)
