"""Worker: the function that a launcher calls for each job of a sweep, on this machine or on another one.

It raises nothing if a job fails or is killed, because the table records that and the sweep continues.
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
