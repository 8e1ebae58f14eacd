"""``cadam3d eval``: measure the quality of a finished run, or of every run of a sweep; compare two arms."""

import shlex
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from cadam3d import report
from cadam3d.build import component
from cadam3d.commands.measuring import build_metrics, measure, rebuild_start
from cadam3d.commands.opened import find_run, open_run, renderer
from cadam3d.core.checks import require
from cadam3d.core.console import complain, show
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.initializer.base import Initializer
from cadam3d.io.jsonl import write_json
from cadam3d.io.records import MEASUREMENTS, NUMBERS, psnr_of, read_summary, with_earlier
from cadam3d.io.run_folder import CONFIG, EVALUATION, LATEST, shown, typed_path
from cadam3d.metric.base import Measurand
from cadam3d.prior.base import DiffusionPrior
from cadam3d.prior.truth import TruthSource
from cadam3d.settings.compose import Call
from cadam3d.settings.trust import read_components, require_contained
from cadam3d.sweep.folder import is_sweep, load
from cadam3d.sweep.table import as_text, write_table


def run(cfg: DictConfig, call: Call) -> None:
    """Measure ``run=`` and write its ``eval.json``; for a sweep, measure every job and write its report.

    With ``arms=``, compare two arms of a sweep from what has been measured.
    """
    if cfg.run is None:
        raise UserError(f"run: expected a finished run or a sweep, got nothing. Try: run={LATEST}")
    folder = typed_path(str(cfg.run))
    if folder.is_dir():
        require_contained(folder, None if cfg.trust else trusting(call))
    if cfg.arms is not None:
        expected, example = "a sweep, because arms= compares its arms", "run=multirun/thresholds"
        require(is_sweep(folder), "run", expected=expected, got=str(cfg.run), example=example)
        text, files = report.compare_two(folder, list(cfg.arms))
        show("\n".join([text, *(str(shown(file)) for file in files)]))
        return
    # If a model is missing, this stops with one message, instead of one for every job.
    build_metrics(cfg)
    if is_sweep(folder):
        _evaluate_sweep(cfg, call, folder)
        return
    result = evaluate(cfg, call, find_run(str(cfg.run)))
    show(_as_text(result))
    write_json(folder / EVALUATION, with_earlier(result, folder, cfg.metric))
    show(f"\n{shown(folder / EVALUATION)}")


def evaluate(cfg: DictConfig, call: Call, folder: Path) -> dict[str, Any]:
    """Return what the metrics of ``cfg`` measure of the run in ``folder``, for its ``eval.json``.

    The rasterizer, the prior and the truth come from the run unless ``cfg`` names another one.
    If there are no true images, a note in the file replaces ``psnr`` and ``ssim``. Raises ``UserError`` if
    the run names components that must not be built without ``trust=true``, and for a prompt that the truth
    cannot read.
    """
    components_of = partial(
        read_components,
        folder / CONFIG,
        folders=call.folders,
        is_trusted=cfg.trust,
        retry=trusting(call),
    )
    own = components_of(("prior", "rasterizer", "truth"))
    asset = open_run(folder, cfg.device)
    device = asset.gaussians.device
    prior = component(own.prior, DiffusionPrior, "prior").to(device)
    source: TruthSource = component(cfg.get("truth", own.truth), TruthSource, "truth")
    truth = source.of(own.prompt, prior)

    def start() -> Gaussians:
        settings = components_of(("initializer",))
        initializer: Initializer = component(settings.initializer, Initializer, "initializer")
        return rebuild_start(settings.prompt, initializer, settings.seed, device)

    warnings: list[str] = []
    # By these two numbers, readers of the file recognise whether it describes the present asset.
    result: dict[str, Any] = {"run": str(shown(folder)), "prompt": own.prompt}
    result["num_gaussians"] = len(asset.gaussians)
    if (steps := read_summary(folder).get("steps")) is not None:
        result["steps"] = steps
    result |= measure(
        build_metrics(cfg),
        Measurand(
            gaussians=asset.gaussians,
            render=renderer(own.rasterizer, asset.gaussians),
            prompt=own.prompt,
            truth=truth,
            asset=asset.file,
        ),
        start if source.measures_start else None,
        warnings,
    )
    if warnings:
        result["warnings"] = warnings
    if truth is None:
        result["note"] = "this run has no true images, so psnr and ssim are missing"
    return result


def _as_text(result: Mapping[str, Any]) -> str:
    """Return the entries of an ``eval.json``, one line each; scores say how they were measured."""
    records = result.get(MEASUREMENTS, {})
    # Metrics that have measured no number say why.
    missing = {name: "-" for name in records if name not in result}
    lines = []
    for name, value in {**result, **missing}.items():
        if name in (MEASUREMENTS, NUMBERS):
            continue
        record = records.get(name, {})
        text = f"{value:.4f}" if isinstance(value, float) else str(value)
        how = [record.get("reason"), record.get("model")]
        how += [f"protocol={record['protocol']['name']}"] if "protocol" in record else []
        lines.append(f"{name:<20}{text}   {', '.join(filter(None, how))}".rstrip())
    return "\n".join(lines)


def trusting(call: Call) -> str:
    """Return this command line with ``trust=true``."""
    return shlex.join(["cadam3d", "eval", *call.words, "trust=true"])


def _evaluate_sweep(cfg: DictConfig, call: Call, folder: Path) -> None:
    """Measure every job of a sweep, and write the ``eval.json`` and the report of the sweep."""
    results: list[dict[str, Any]] = []
    for job in (row.folder for row in load(folder)):
        try:
            measured = evaluate(cfg, call, find_run(str(job)))
        except UserError as error:
            results.append({"run": str(shown(job)), "message": str(error)})
            complain(f"{job.name}: {error}")
            continue
        psnr = psnr_of(measured)
        quality = "no psnr" if psnr is None else f"{psnr:6.2f} dB"
        show(f"{quality}  {measured['num_gaussians']:>8} Gaussians  {job.name}")
        results.append(with_earlier(measured, job, cfg.metric))
        write_json(job / EVALUATION, results[-1])
    if all("message" in result for result in results):
        raise UserError(f"run: no job of {cfg.run} could be measured, for the reasons above")
    write_json(folder / EVALUATION, results)
    show(f"\n{as_text(write_table(folder))}")
    table = report.write_paper_table(folder)
    show(f"\n{len(results)} jobs: {shown(folder / EVALUATION)}\nreport: {shown(report.write_sweep(folder))}")
    if table:
        show(f"\n{table}")
