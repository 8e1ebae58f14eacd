"""Tiny real pipelines, each built at most once per process, and the order of the test files."""

from collections.abc import Callable
from pathlib import Path

import pytest

# Files with whole runs come first, because each is run by one process and should not be the last to end.
LONG = ("test_end_to_end", "test_configs", "test_cuda", "test_recipes", "test_cuda_sanitizer", "test_cpu")


def pytest_collection_modifyitems(items):
    def place(item):
        return LONG.index(item.path.stem) if item.path.stem in LONG else len(LONG)

    items.sort(key=place)


@pytest.fixture(scope="session")
def pipelines(tmp_path_factory) -> Callable[..., Path]:
    """Return a function that calls a builder of pipelines.py by name and returns its folder."""
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
