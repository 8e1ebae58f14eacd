"""Fixtures for tests of the Python API."""

import jaxtyping
import pytest


@pytest.fixture
def without_type_checks():
    """Switch off the checks of types that the suite adds, which users do not have."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)
