"""A small CLIP model, saved once for all tests of this folder."""

import pipelines
import pytest


@pytest.fixture(scope="session")
def clip_folder(tmp_path_factory):
    """Return the folder of a small random CLIP model. Tests must not change it."""
    return pipelines.clip(tmp_path_factory.mktemp("models") / "clip")
