"""Configurations of which several tests need the same one. Composing takes longer than many a test."""

from functools import cache

from omegaconf import DictConfig, OmegaConf

from cadam3d.settings.compose import compose


@cache
def composed(*lines: str) -> DictConfig:
    """Return the configuration of training with these overrides. All callers share it, so none changes it."""
    return compose(lines)


@cache
def as_yaml(*lines: str) -> str:
    """Return the content of ``config.yaml`` in the folder of a run with these overrides."""
    return OmegaConf.to_yaml(compose(lines), resolve=True)
