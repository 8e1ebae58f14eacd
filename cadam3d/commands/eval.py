"""``cadam3d eval``: measure the quality of a finished run, or of every run of a sweep."""

import sys
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from cadam3d import report
from cadam3d.commands.asset import find_run, open_run, renderer, run_config
from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import write_json
from cadam3d.io.run_folder import EVALUATION, shown
from cadam3d.settings.compose import component, components
from cadam3d.sweep.folder import is_sweep, load


def run(cfg: DictConfig) -> None:
    """Measure ``run=`` and write its ``eval.json``; for a sweep, measure every job and write its report."""
    if cfg.run is None:
        raise UserError("run: expected a finished run or a sweep. Try: cadam3d eval run=outputs/latest")
    folder = Path(cfg.run).expanduser().resolve()
    if is_sweep(folder):
        _evaluate_sweep(cfg, folder)
        return
    result = evaluate(cfg, find_run(cfg.run))
    for name, value in result.items():
        print(f"{name:<20}{value:.4f}" if isinstance(value, float) else f"{name:<20}{value}")
    print(f"\n{shown(folder / EVALUATION)}")


def evaluate(cfg: DictConfig, folder: Path) -> dict[str, Any]:
    """Measure the run in ``folder`` with the metrics of ``cfg``, and write its ``eval.json``.

    The rasterizer and the prior are those of the run. ``psnr`` and ``ssim`` compare with the true images of
    the prior. If the prior has no true images, a note in the file replaces these two.
    """
    source = run_config(folder)
    asset = open_run(folder, cfg.device)
    device = asset.gaussians.device
    prior = component(source.prior).to(device)
    truth = prior.truth(source.prompt)
    render = renderer(source.rasterizer, asset.gaussians)
    result: dict[str, Any] = {"run": str(shown(folder)), "prompt": source.prompt}
    for metric in components(cfg.metric).values():
        result |= metric.measure(asset.gaussians, render, truth, asset.ply)
    if truth is None:
        result["note"] = "this prior has no true images, so psnr and ssim are missing"
    write_json(folder / EVALUATION, result)
    return result


def _evaluate_sweep(cfg: DictConfig, folder: Path) -> None:
    """Measure every job of a sweep, and write the ``eval.json`` and the report of the sweep."""
    results, failures = [], 0
    for job in (row.folder for row in load(folder)):
        try:
            results.append(evaluate(cfg, find_run(str(job))))
        except UserError as error:
            failures += 1
            results.append({"run": str(shown(job)), "message": str(error)})
            print(f"cadam3d: {job.name}: {error}", file=sys.stderr)
            continue
        psnr = results[-1].get("psnr")
        quality = "no psnr" if psnr is None else f"{psnr:6.2f} dB"
        print(f"{quality}  {results[-1].get('num_gaussians', '-'):>8} Gaussians  {job.name}")
    if failures == len(results):
        raise UserError(
            f"run={cfg.run}: no job of this sweep could be measured, and the reasons are above. "
            "Run the sweep again, after a look at this machine. Try: cadam3d doctor"
        )
    write_json(folder / EVALUATION, results)
    print(f"\n{len(results)} jobs: {shown(folder / EVALUATION)}\nreport: {shown(report.write_sweep(folder))}")
