"""Fixtures for tests of the Python API."""

import os
from pathlib import Path

import jaxtyping
import pytest


@pytest.fixture(autouse=True, scope="module")
def _elsewhere(tmp_path_factory):
    """Run the tests of a file in a new folder, because every run makes a link in ``outputs``."""
    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("elsewhere"))
    yield
    os.chdir(before)


@pytest.fixture
def without_type_checks():
    """Switch off the checks of types that the suite adds, which users do not have."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)
