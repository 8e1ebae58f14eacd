"""Prompts: the sets of prompts that come with this package, one YAML file each."""

from pathlib import Path

SETS = Path(__file__).with_name("prompt_sets")


def set_names() -> list[str]:
    """Return the names of the sets, in alphabetical order."""
    return sorted(path.stem for path in SETS.glob("*.yaml"))


def set_file(name: str) -> Path:
    """Return the file of a set, which exists if ``name`` is one of :func:`set_names`."""
    return SETS / f"{name}.yaml"
