"""Tiny real pipelines, each built at most once per process."""

from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def pipelines(tmp_path_factory) -> Callable[..., Path]:
    """``pipelines("stable_diffusion")``: the folder that the function of that name in pipelines.py saves."""
    for name in ("diffusers", "transformers"):
        pytest.importorskip(name)
    import pipelines as builders

    built: dict[tuple, Path] = {}

    def build(name: str, **options) -> Path:
        key = (name, *sorted(options.items()))
        if key not in built:
            built[key] = getattr(builders, name)(tmp_path_factory.mktemp(name), **options)
        return built[key]

    return build
