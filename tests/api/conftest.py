"""Fixtures for tests of the Python API."""

import logging
import os
import signal
import warnings
from pathlib import Path

import jaxtyping
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobRuntime
from hydra.version import VersionBase
from omegaconf import OmegaConf


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


@pytest.fixture
def process_state():
    """Return a function that returns what a library must not change."""

    def state() -> dict[str, object]:
        logger, root = logging.getLogger("cadam3d"), logging.getLogger()
        return {
            "version": VersionBase.instance().getbase(),
            "job": JobRuntime.instance().get("name"),
            "hydra": GlobalHydra.instance().hydra,
            "config": HydraConfig.instance().cfg,
            "resolvers": OmegaConf.create({"a": "${slug:x}"}).a,
            "determinism": torch.get_deterministic_debug_mode(),
            "dtype": torch.get_default_dtype(),
            "grad": torch.is_grad_enabled(),
            "signals": [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)],
            "logging": (
                root.level,
                list(root.handlers),
                logger.level,
                list(logger.handlers),
                logger.propagate,
            ),
            "folder": Path.cwd(),
            "environment": dict(os.environ),
            "warnings": list(warnings.filters),
            "random": torch.get_rng_state().sum().item(),
        }

    return state
