"""``cadam3d doctor``: check this machine, and print what to type if something is missing or broken."""

import json
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from enum import StrEnum
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

# The packages that are imported under another name.
IMPORT_NAMES = {"hydra-core": "hydra", "pillow": "PIL", "pyyaml": "yaml", "scikit-image": "skimage"}
CPU = torch.device("cpu")
# Failures that do not end a training, because auto chooses another backend then.
REPLACED = ("rasterizer=cuda", "rasterizer=gsplat")
REPORT = "Please report this. Until it is fixed, use {}"


class Verdict(StrEnum):
    """The meaning of a finding for training."""

    OK = "ok"
    NOTE = "note"  # not available, and not needed by default
    BROKEN = "broken"


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    topic: str
    verdict: Verdict
    found: str
    hint: str = ""  # what to type; empty if nothing is wrong


def run(cfg: DictConfig, _call: Call) -> None:
    """Print every finding; exit with 1 if one of them is broken."""
    findings = list(examine())
    broken = [finding for finding in findings if finding.verdict is Verdict.BROKEN]
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
    yield Finding("python", Verdict.OK, f"{system}, cadam3d {__version__}")
    yield from map(check_package, dependencies())
    yield attempt("device", check_device, is_needed=True)
    yield attempt("ffmpeg", check_ffmpeg, is_needed=True)
    yield attempt("configs", check_configs, is_needed=True)
    yield check_compilers()
    yield from check_rasterizers()
    yield attempt("prior.tracer=auto", check_tracer)
    for name in option_names("prior"):
        yield attempt(f"prior={name}", partial(check_prior, name))


def attempt(topic: str, check: Callable[[], Finding], *, is_needed: bool = False) -> Finding:
    """Return the finding of ``check``, or one about the error that it raises.

    The error is a note if something is not available that training does not need.
    """
    try:
        return check()
    except Exception as error:
        is_note = isinstance(error, UserError | ImportError | OSError) and not is_needed
        first, *others = str(error).splitlines() or [type(error).__name__]
        if is_note:
            return Finding(topic, Verdict.NOTE, first, others[-1] if others else "")
        hint = "Try: pip install --upgrade --force-reinstall ."
        return Finding(topic, Verdict.BROKEN, f"{type(error).__name__}: {first}", hint)


def dependencies() -> list[str]:
    """Return the names of the packages that cadam3d needs without extras."""
    lines = [line for line in metadata.requires("cadam3d") or () if "extra ==" not in line]
    return [re.split(r"[^\w-]", line)[0] for line in lines]


def check_package(name: str) -> Finding:
    """Import a package."""
    try:
        import_module(IMPORT_NAMES.get(name, name.replace("-", "_")))
        return Finding(name, Verdict.OK, metadata.version(name))
    except Exception as error:
        # The code of a package may raise anything when it is imported.
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        return Finding(name, Verdict.BROKEN, reason, f"Try: pip install --force-reinstall {name}")


def check_device() -> Finding:
    """Name the device that trains. A GPU that torch cannot use is a note."""
    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(0)
        memory = properties.total_memory / 2**30
        return Finding(
            "device", Verdict.OK, f"{properties.name}, {memory:.0f} GiB, CUDA {torch.version.cuda}"
        )
    found, command = f"CPU, {torch.get_num_threads()} threads", ["nvidia-smi", "-L"]
    if shutil.which(command[0]) and subprocess.run(command, capture_output=True, check=False).returncode == 0:
        hint = "Try: pip install --force-reinstall torch, with the CUDA version of your driver"
        return Finding("device", Verdict.NOTE, f"{found}; torch cannot use the GPU", hint)
    return Finding("device", Verdict.OK, found)


def check_ffmpeg() -> Finding:
    """Run ffmpeg."""
    version = imageio_ffmpeg.get_ffmpeg_version()
    return Finding("ffmpeg", Verdict.OK, f"{version}, {imageio_ffmpeg.get_ffmpeg_exe()}")


def check_configs() -> Finding:
    """Compose the default settings."""
    cfg = compose(["prompt=test"])
    return Finding("configs", Verdict.OK, f"{config_dir()}, {len(cfg)} settings and groups")


def check_compilers() -> Finding:
    """Name the compilers of the kernels: a C++ compiler, and NVRTC for a GPU."""
    native, nvidia = library.find_compiler(), nvrtc.find_compiler()
    found = [native.version] if native else []
    found += ["NVRTC {}.{}".format(*nvidia.version)] if nvidia else []
    return Finding("compilers", Verdict.OK if found else Verdict.NOTE, ", ".join(found) or "none")


def check_rasterizers() -> Iterator[Finding]:
    """Compile and test each backend on each device. ``auto`` is last because it would compile silently."""
    devices = [CPU, *(torch.device("cuda", i) for i in range(torch.cuda.device_count()))]
    for device in devices:
        is_cpu = device == CPU
        tests: list[tuple[str, Rasterizer, Demands]] = [
            ("reference", ReferenceRasterizer(), OWN if is_cpu else ATOMIC)
        ]
        if is_cpu:
            tests += [("cpu", CpuRasterizer(cache_dir=None), OWN)]
        else:
            tests += [
                ("cuda", CudaRasterizer(cache_dir=None), OWN),
                ("gsplat", GsplatRasterizer(), GSPLAT),
            ]
        for name, rasterizer, demands in tests:
            topic = f"rasterizer={name}"
            yield attempt(topic, partial(check_rasterizer, topic, rasterizer, device, demands))
    for device in devices:
        yield attempt("rasterizer=auto", partial(check_choice, device))


def check_rasterizer(topic: str, rasterizer: Rasterizer, device: torch.device, demands: Demands) -> Finding:
    """Compile a backend and compare it with the reference. Raises ``UserError`` if it is not available."""
    rasterizer.prepare(device)
    agreement = self_test(rasterizer, device, demands)
    found = f"{agreement}, on {device}"
    if agreement.passes:
        return Finding(topic, Verdict.OK, found)
    verdict = Verdict.NOTE if topic in REPLACED else Verdict.BROKEN
    return Finding(topic, verdict, found, REPORT.format("rasterizer=reference"))


def check_choice(device: torch.device) -> Finding:
    """Name the backend that ``auto`` chooses."""
    backend = AutoRasterizer().prepare(device)
    chosen = f"chooses {backend.name} on {device}"
    if backend.reason is None:
        return Finding("rasterizer=auto", Verdict.OK, chosen)
    first, *others = backend.reason.splitlines()
    return Finding("rasterizer=auto", Verdict.NOTE, f"{chosen}: {first}", *others[-1:])


def check_tracer() -> Finding:
    """Compile the native tracer, which tests itself. Raises ``UserError`` if it is not available."""
    load_tracer()
    return Finding("prior.tracer=auto", Verdict.OK, "native")


def check_prior(name: str) -> Finding:
    """Build a prior without its weights, and say what it lacks."""
    topic = f"prior={name}"
    prior = component(compose(["prompt=test", topic]).prior)
    if (lack := prior.lacks()) is not None:
        return Finding(topic, Verdict.NOTE, lack)
    return Finding(topic, Verdict.OK, (prior.notice() or "ready").splitlines()[0])
