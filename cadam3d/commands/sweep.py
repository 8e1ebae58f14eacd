"""``cadam3d sweep``: one job of it, as the launcher that Hydra was given runs it, here or elsewhere.

The sweep itself is prepared and watched in ``cadam3d.sweep.start``. A job that fails or dies is a row of the
table, not the end of the sweep, so nothing is raised here for it.
"""

from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from cadam3d.sweep.process import run_job
from cadam3d.sweep.table import write_table


def run(cfg: DictConfig) -> None:
    """Run job number ``cfg.job`` of the sweep and bring the table up to date."""
    sweep = Path(HydraConfig.get().sweep.dir)
    run_job(sweep, cfg.job)
    write_table(sweep)
