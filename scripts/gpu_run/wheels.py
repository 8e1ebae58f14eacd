"""The packages that a machine without a package registry must bring along, beside Python and torch."""

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

from gpu_run.machine import REPOSITORY

PYTHON = "3.12"
# pip does not know that a newer one of these systems can use wheels for an older one.
PLATFORMS = ("manylinux_2_28_x86_64", "manylinux_2_17_x86_64", "manylinux2014_x86_64")


@dataclass(frozen=True)
class Package:
    """A package, and the part of the run that needs it."""

    name: str
    purpose: str
    # A pure wheel fits every Python and system. Others are for one Python version and one kind of machine.
    is_pure: bool = True
    # If the project does not ask for the package itself, the versions that the packages above accept.
    bounds: str = ""
    has_wheel: bool = True


CHECKS, GSPLAT, DEMO, RECIPES = "checks and times", "gsplat", "the demo", "the recipes"
# Torch brings filelock, and nearly always numpy. The order is that of the parts of a run.
PACKAGES = (
    Package("numpy", CHECKS, is_pure=False),
    Package("jaxtyping", CHECKS),
    Package("wadler-lindig", CHECKS),
    Package("hydra-core", CHECKS),
    Package("omegaconf", CHECKS),
    Package("antlr4-python3-runtime", CHECKS, bounds="==4.9.3", has_wheel=False),
    Package("packaging", CHECKS),
    Package("pyyaml", CHECKS, is_pure=False),
    Package("tqdm", CHECKS),
    Package("pytest", CHECKS),
    Package("pluggy", CHECKS),
    Package("iniconfig", CHECKS),
    Package("pygments", CHECKS),
    Package("gsplat", GSPLAT),
    Package("ninja", GSPLAT, is_pure=False),
    Package("rich", GSPLAT),
    Package("markdown-it-py", GSPLAT),
    Package("mdurl", GSPLAT),
    Package("kornia", DEMO),
    Package("kornia-rs", DEMO, is_pure=False),
    Package("jinja2", DEMO),
    Package("markupsafe", DEMO, is_pure=False),
    Package("scipy", DEMO, is_pure=False),
    Package("imageio", DEMO),
    Package("pillow", DEMO, is_pure=False),
    Package("matplotlib", DEMO, is_pure=False),
    Package("contourpy", DEMO, is_pure=False),
    Package("cycler", DEMO),
    Package("fonttools", DEMO, is_pure=False),
    Package("kiwisolver", DEMO, is_pure=False),
    Package("pyparsing", DEMO),
    Package("python-dateutil", DEMO),
    Package("six", DEMO),
    Package("diffusers", RECIPES),
    Package("importlib-metadata", RECIPES),
    Package("zipp", RECIPES),
    Package("huggingface-hub", RECIPES),
    Package("safetensors", RECIPES, is_pure=False),
    Package("regex", RECIPES, is_pure=False),
    Package("requests", RECIPES),
    Package("httpx", RECIPES),
)


def requirement(package: Package, repository: Path = REPOSITORY) -> str:
    """Return the name with the bounds of pyproject.toml (from below) and constraints.txt (from above)."""
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    lines = [
        *project["dependencies"],
        *(line for lines in project["optional-dependencies"].values() for line in lines),
    ]
    lines += (repository / "constraints.txt").read_text().splitlines()
    found = [re.match(r"([A-Za-z0-9_.-]+?)((?:[<>=!~]=?[\w.]+,?)+)", line) for line in lines]
    bounds = {match[2] for match in found if match and _plain(match[1]) == _plain(package.name)}
    return package.name + (package.bounds or ",".join(sorted(bounds, reverse=True)))


def _plain(name: str) -> str:
    return name.lower().replace("_", "-")


def describe() -> str:
    """Return the packages with their bounds, and the lines that fetch and install them."""
    lines = [
        "A machine without a package registry needs torch built for CUDA, and these packages beside it.",
        "A pure wheel fits every Python. Fetch the others for the Python and the system of that machine.",
    ]
    for purpose in dict.fromkeys(package.purpose for package in PACKAGES):
        lines += ["", f"for {purpose}" + ("" if purpose == CHECKS else " (optional)") + ":"]
        for package in PACKAGES:
            if package.purpose == purpose:
                kind = (
                    "no wheel: build one"
                    if not package.has_wheel
                    else "pure"
                    if package.is_pure
                    else "not pure"
                )
                lines.append(f"  {requirement(package):<36} {kind}")
    return "\n".join([*lines, "", *fetching()])


def fetching() -> list[str]:
    """Return the lines to type for the packages that the checks and the times need."""
    needed = [package for package in PACKAGES if package.purpose == CHECKS]
    with_wheel = " ".join(f"'{requirement(package)}'" for package in needed if package.has_wheel)
    without = " ".join(f"'{requirement(package)}'" for package in needed if not package.has_wheel)
    names = " ".join(package.name for package in needed)
    platforms = " ".join(f"--platform {platform}" for platform in PLATFORMS)
    return [
        "On a machine with a registry, for the checks and the times:",
        f"  pip download --no-deps --only-binary=:all: --python-version {PYTHON} {platforms} "
        f"--dest wheels {with_wheel}",
        f"  pip wheel --no-deps --wheel-dir wheels {without}",
        "On the machine with the GPU, in the folder of the project:",
        f"  python3 -m pip install --no-index --no-deps --find-links wheels --target site {names}",
        "  PYTHONPATH=site python3 scripts/gpu.py",
        "Leave out what is installed there already. gsplat also needs nvcc, and the video of the demo "
        "imageio-ffmpeg (30 MB or more); without them their lines of the report say so.",
    ]
