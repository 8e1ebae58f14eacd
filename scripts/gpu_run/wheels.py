"""The packages to copy to a machine without a package registry, beside Python and torch."""

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

from gpu_run.machine import REPOSITORY

PYTHON = "3.12"
# The system of the wheel, newest first; pip accepts an older one only if it is listed too.
PLATFORMS = ("manylinux_2_28_x86_64", "manylinux_2_17_x86_64", "manylinux2014_x86_64")


@dataclass(frozen=True)
class Package:
    """A package, and the part of the run that needs it."""

    name: str
    purpose: str
    # A pure wheel fits every Python and system. Others are for one Python version and one kind of machine.
    is_pure: bool = True
    # The versions that the packages above accept, if the project does not require the package itself.
    bounds: str = ""
    has_wheel: bool = True


CHECKS, GSPLAT, DEMO, RECIPES = "checks and times", "gsplat", "the demo", "the recipes"
# A package that the project does not require itself is below the one that requires it. Filelock comes with
# torch.
PACKAGES = (
    Package("numpy", CHECKS, is_pure=False),
    Package("jaxtyping", CHECKS),
    Package("wadler-lindig", CHECKS),
    Package("hydra-core", CHECKS),
    Package("omegaconf", CHECKS),
    Package("antlr4-python3-runtime", CHECKS, bounds="==4.9.3", has_wheel=False),
    Package("packaging", CHECKS),
    Package("pyyaml", CHECKS, is_pure=False),
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
    Package("tqdm", DEMO),
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
    """Return the lines to type for the checks and the times, and those for one optional part."""

    def named(purpose: str, has_wheel: bool) -> str:
        chosen = [each for each in PACKAGES if (each.purpose, each.has_wheel) == (purpose, has_wheel)]
        return " ".join(f"'{requirement(package)}'" for package in chosen)

    platforms = " ".join(f"--platform {platform}" for platform in PLATFORMS)
    download = f"  pip download --only-binary=:all: --python-version {PYTHON} {platforms} --dest wheels "
    names = " ".join(package.name for package in PACKAGES if package.purpose == CHECKS)
    return [
        "On a machine with a registry, in the folder of the project, for the checks and the times:",
        f"  pip wheel --no-deps --wheel-dir wheels {named(CHECKS, has_wheel=False)}",
        f"{download}--find-links wheels --constraint constraints.txt {named(CHECKS, has_wheel=True)}",
        "For an optional part, without the packages that it shares with torch:",
        f"{download}--no-deps {named(GSPLAT, has_wheel=True)}",
        "On the machine with the GPU, in the folder of the project:",
        f"  python3 -m pip install --no-index --find-links wheels --target site {names}",
        "  PYTHONPATH=site python3 scripts/gpu.py",
        "gsplat also needs nvcc, and the video of the demo needs imageio-ffmpeg (30 MB or more).",
        "What is missing is named in the report and skipped.",
    ]
