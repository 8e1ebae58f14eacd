"""``cadam3d doctor``: check this machine, and print what to type if something is missing or broken."""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from importlib import import_module, metadata
from pathlib import Path

from omegaconf import DictConfig

from cadam3d import __version__
from cadam3d.build import component
from cadam3d.commands.finding import Finding, Verdict, attempt
from cadam3d.settings.compose import Call, compose
from cadam3d.settings.options import config_dir, option_names

PACKAGES = ("torch", "numpy", "hydra-core", "omegaconf", "fast-simplification", "imageio", "imageio-ffmpeg")
PACKAGES += (
    "jaxtyping",
    "jinja2",
    "kornia",
    "matplotlib",
    "pillow",
    "pydantic",
    "pyyaml",
    "scikit-image",
    "scipy",
)
PACKAGES += ("tqdm", "trimesh")
IMPORT_NAMES = {"hydra-core": "hydra", "imageio-ffmpeg": "imageio_ffmpeg", "pillow": "PIL", "pyyaml": "yaml"}
IMPORT_NAMES |= {"fast-simplification": "fast_simplification", "scikit-image": "skimage"}
COMPILERS = ("c++", "g++", "clang++", "nvcc")
SECONDS = 60  # longest wait for a program


def run(cfg: DictConfig, _call: Call) -> None:
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
    """Run all checks. A check that fails does not stop the following ones."""
    yield _python()
    yield from map(_package, PACKAGES)
    for topic, check in (
        ("torchvision", _torchvision),
        ("device", _device),
        ("ffmpeg", _ffmpeg),
        ("configs", _configs),
    ):
        yield attempt(topic, check, is_needed=True)
    yield from map(_compiler, COMPILERS)
    yield from _kernels()
    for name in option_names("prior"):
        yield attempt(f"prior={name}", partial(_prior, f"prior={name}"))
    yield from (_diffusers(), _models())


def _python() -> Finding:
    version = platform.python_version()
    found = f"{version} on {platform.system()} {platform.machine()}, cadam3d {__version__}"
    if (3, 11) <= sys.version_info[:2] <= (3, 13):
        return Finding("python", Verdict.OK, found)
    return Finding(
        "python", Verdict.BROKEN, found, "Expected 3.11 to 3.13. Try: make clean demo PYTHON=python3.12"
    )


def _package(name: str) -> Finding:
    try:
        import_module(IMPORT_NAMES.get(name, name))
        return Finding(name, Verdict.OK, metadata.version(name))
    except Exception as error:
        # The code of a package may raise anything when it is imported.
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        return Finding(name, Verdict.BROKEN, reason, f"Try: pip install --force-reinstall {name}")


def _torchvision() -> Finding:
    """Check that torchvision fits torch. Otherwise diffusers and other packages that import it fail."""
    try:
        version = metadata.version("torchvision")
    except metadata.PackageNotFoundError:
        return Finding("torchvision", Verdict.OK, "not installed, not needed")
    code, output = _run_program([sys.executable, "-P", "-c", "import torchvision"])
    if code == 0:
        return Finding("torchvision", Verdict.OK, version)
    reason = output.strip().splitlines()[-1] if output.strip() else "does not import"
    found = f"{version} does not fit torch: {reason}"
    return Finding("torchvision", Verdict.BROKEN, found, "Try: pip uninstall torchvision")


def _device() -> Finding:
    import torch

    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(0)
        memory = properties.total_memory / 2**30
        return Finding(
            "device", Verdict.OK, f"{properties.name}, {memory:.0f} GiB, CUDA {torch.version.cuda}"
        )
    found = f"CPU, {torch.get_num_threads()} threads"
    if shutil.which("nvidia-smi") and _run_program(["nvidia-smi", "-L"])[0] == 0:
        hint = "Try: pip install --force-reinstall torch, with the CUDA version of your driver"
        return Finding("device", Verdict.NOTE, f"{found}; torch cannot use the GPU", hint)
    return Finding("device", Verdict.OK, found)


def _ffmpeg() -> Finding:
    import imageio_ffmpeg

    path = imageio_ffmpeg.get_ffmpeg_exe()
    code, output = _run_program([path, "-version"])
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
        return Finding(name, Verdict.NOTE, "not found; one C++ compiler is enough, and nvcc is not needed")
    code, output = _run_program([path, "--version"])
    if code != 0:
        return Finding(name, Verdict.NOTE, f"{path} does not run")
    lines = output.strip().splitlines() or [path]
    # nvcc prints its version on the fourth line.
    release = [line for line in lines if "release" in line]
    return Finding(name, Verdict.OK, (release or lines)[0].strip())


def _kernels() -> Iterator[Finding]:
    try:
        from cadam3d.commands.doctor_kernels import check_kernels
    except Exception as error:
        # For example, torch cannot be imported. The check of that package has reported it already.
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        yield Finding("rasterizers", Verdict.BROKEN, f"cannot be loaded: {reason}")
        return
    yield from check_kernels()


def _prior(topic: str) -> Finding:
    prior = component(compose(["prompt=test", topic]).prior)
    if (lack := prior.lacks()) is not None:
        return Finding(topic, Verdict.NOTE, lack)
    return Finding(topic, Verdict.OK, (prior.notice() or "ready").splitlines()[0])


def _diffusers() -> Finding:
    try:
        return Finding("diffusers", Verdict.OK, metadata.version("diffusers"))
    except metadata.PackageNotFoundError:
        return Finding("diffusers", Verdict.NOTE, "not installed; only priors that are networks need it")


def _models() -> Finding:
    """List the models in the cache of the Hugging Face hub."""
    home = Path(os.environ.get("HF_HOME") or Path("~/.cache/huggingface").expanduser())
    cache = Path(os.environ.get("HF_HUB_CACHE") or home / "hub")
    names = [folder.name.split("--", 1)[1].replace("--", "/") for folder in sorted(cache.glob("models--*"))]
    if not names:
        return Finding("models on disk", Verdict.NOTE, f"none in {cache}; prior=shapes needs none")
    return Finding("models on disk", Verdict.OK, ", ".join(names))


def _run_program(command: list[str]) -> tuple[int, str]:
    """Return the exit code and output of a program; code 127 if it cannot be run or does not end in time."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return 127, str(error)
    return done.returncode, done.stdout + done.stderr
