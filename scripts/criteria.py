"""Score what densifiers look at against the gain of refining each Gaussian, which an exact prior knows.

    OMP_NUM_THREADS=1 python scripts/criteria.py   # adds what docs/data/criteria.csv lacks, and draws

A run stops one step before a refinement, and its Gaussians are frozen. Many trials then refine a random part
of them, fine-tune on the true images, and compare held-out views with the truth. The gain of a Gaussian is
how much less squared error there is where it is seen in the trials that refine it than in the others.
``docs/notes/criteria.md`` describes the method and the results.
"""

import argparse
import csv
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from measuring import HERE, commit, header, line_of, processor
from scipy.stats import rankdata
from torch import Tensor

import cadam3d
from cadam3d.api.stepping import Stepper
from cadam3d.build import option
from cadam3d.core.cameras import Cameras, turntable
from cadam3d.core.edit import RowEdit, RowState
from cadam3d.core.gaussians import Gaussians
from cadam3d.densifier.absgrad import AbsGrad, AbsGradState
from cadam3d.densifier.base import Densifier, GradientSignal
from cadam3d.densifier.cadam import CAdam, CAdamState
from cadam3d.io.text_tables import write_csv
from cadam3d.optimizer import GaussianOptimizer
from cadam3d.prior.base import Condition
from cadam3d.report.style import COLORS, styled
from cadam3d.trainer import Trainer

DATA, FIGURE = HERE / "docs/data/criteria.csv", HERE / "docs/images/criteria.png"
# None of these is in the grids that compare densifiers, and each leaves nothing open.
BENCH = ["experiment=bench", "prior=shapes", "prior.samples_per_pixel=1"]
REAL = ["experiment=objects", "prior.samples_per_pixel=1", "camera.size=96", "initializer.count=400"]
REAL += ["guidance.scale=1"]  # true colours at every level of noise
OBJECTS = {
    "a blue and yellow checkered mug": BENCH,
    "forklift": REAL,
    "a red and white striped rocket": BENCH,
    "chicken": REAL,
    "a green cactus on a red cube": BENCH,
    "pagoda lantern": REAL,
}
NOISE = ("weak", "strong", "medium")
PHASES = {"early": 179, "late": 399}  # steps of 600; refinements end at 450
SHARE = 0.2  # of Gaussians, those with the largest gain, which a criterion should find
CHOSEN = 0.1  # of Gaussians, which a criterion refines
GROUPS, PARTITIONS = 8, 4  # of all Gaussians, at random; one trial refines one group
STEPS = 60  # of fine-tuning after a refinement
VIEWS, NOISES = 24, 4  # of which the parts of the variance are estimated
RESAMPLES = 200
SH_0 = 0.28209479177387814  # the constant harmonic: colour = 0.5 + SH_0 sh
TINY = 1e-20
PARTS = ("drift_part", "view_part", "noise_part", "pixel_part")
WORTH = ("mdb_noisy", "mdb_exact")  # PSNR per added Gaussian, in thousandths of a dB
COLUMNS = [
    *("object", "world", "phase", "noise", "criterion", "auc", "low", "high", "auc_seen", "captured"),
    *(*WORTH, *PARTS, "gaussians", "reliability", "seed", "commit", "machine", "threads", "cpu_seconds"),
]
PANELS = {
    "auc": "Area under the ROC curve",
    "captured": "Share of the gain captured",
    "mdb_noisy": "PSNR per added Gaussian (mdB)",
}
Rows = Sequence[Mapping[str, Any]]


@dataclass
class PanelState(RowState):
    """What CAdam and AbsGS remember."""

    cadam: CAdamState
    sums: AbsGradState

    def carry(self, edit: RowEdit) -> "PanelState":
        return PanelState(self.cadam.carry(edit), self.sums.carry(edit))


@dataclass(frozen=True, kw_only=True)
class Panel(Densifier[PanelState]):
    """Grow as CAdam does, and observe what the baseline and AbsGS would see."""

    cadam: CAdam
    absgrad: AbsGrad

    @property
    def needs_absgrad(self) -> bool:
        return True

    def init_state(self, n: int, device: torch.device) -> PanelState:
        return PanelState(self.cadam.init_state(n, device), self.absgrad.init_state(n, device))

    def observe(self, state: PanelState, signal: GradientSignal) -> PanelState:
        return PanelState(self.cadam.observe(state.cadam, signal), self.absgrad.observe(state.sums, signal))

    def select(self, state: PanelState, step: int, generator: torch.Generator) -> Tensor:
        return self.cadam.select(state.cadam, step, generator)

    def unreliable(self, state: PanelState) -> Tensor:
        return self.cadam.unreliable(state.cadam)


@dataclass(frozen=True)
class Shot:
    """Views, with what the prior expects to see there."""

    cameras: Cameras
    background: Tensor  # v 3
    condition: Condition | None
    truth: Tensor  # v h w 3


@dataclass(frozen=True)
class Frozen:
    """A run that has stopped one step before a refinement."""

    parts: Trainer
    gaussians: Gaussians
    adam: Mapping[str, Any]  # the state of the optimizer
    step: int
    seen: PanelState | None
    pairs: Sequence[Shot]  # to train on, two views each
    singles: Sequence[Shot]  # one view each
    held_out: Sequence[Shot]

    def render(self, gaussians: Gaussians, shot: Shot, absgrad: bool = False):
        return self.parts.rasterizer.render(gaussians, shot.cameras, shot.background, absgrad)

    def refined(self, selected: Tensor, seed: int) -> RowEdit:
        """Return what a refinement of ``selected`` does to the rows."""
        draws = torch.Generator().manual_seed(seed)
        edit = self.parts.refine.plan(self.gaussians, selected, self.step + 1, draws).edit
        assert edit is not None
        return edit

    def tune(self, owner: GaussianOptimizer, noise_seed: int | None = None) -> Gaussians:
        """Return the Gaussians after some steps towards the truth, or by the objective of the run."""
        draws = torch.Generator().manual_seed(noise_seed or 0)
        for i, shot in zip(range(STEPS), cycle(self.pairs), strict=False):
            rgb = self.render(owner.gaussians, shot).rgb
            loss = (rgb - shot.truth).square().mean()
            if noise_seed is not None:
                loss = self.parts.guidance(rgb, shot.condition, self.parts.prior, self.step, draws).loss
            loss.backward()
            owner.step(self.step + i)
        return owner.gaussians.detach()

    @torch.no_grad()
    def errors(self, gaussians: Gaussians) -> Tensor:
        """Return the squared error of each held-out pixel, as ``v h w``."""
        shown = [self.render(gaussians, shot).rgb.clamp(0, 1) - shot.truth for shot in self.held_out]
        return torch.cat(shown).square().sum(-1)

    def blended(self, maps: Tensor) -> Tensor:
        """Return the sums of maps ``m v h w`` over the held-out pixels, weighted as each Gaussian is blended.

        The derivative of a pixel's colour by the colour of a Gaussian is its weight there. An image has three
        colours, so that three maps are summed at once.
        """
        found = []
        for three in maps.split(3):
            sh = torch.zeros_like(self.gaussians.sh, requires_grad=True)
            rgb = torch.cat([self.render(replace(self.gaussians, sh=sh), shot).rgb for shot in self.held_out])
            total = (rgb[..., : len(three)] * three.permute(1, 2, 3, 0)).sum()
            found.append(torch.autograd.grad(total, sh)[0][:, 0, : len(three)] / SH_0)
        return torch.cat(found, dim=1).T


def frozen_runs(words: Sequence[str]) -> Iterator[tuple[str, Frozen]]:
    """Yield each phase with the run of ``words``, frozen there."""
    draft = cadam3d.compose(*words, "seed=0", "device=cpu")
    assert isinstance(draft.parts.densifier, CAdam)
    panel = Panel(cadam=draft.parts.densifier, absgrad=option("densifier", "absgs", AbsGrad))
    stepper = replace(draft, parts=replace(draft.parts, densifier=panel))
    state, shots = stepper.start(), shots_of(stepper)
    for phase, stop in PHASES.items():
        while state.step < stop:
            stepper.step(state)
        copy = state.gaussians.detach().map(torch.clone)
        adam = state.optimizer.state_dict()
        adam |= {kind: {k: v.clone() for k, v in adam[kind].items()} for kind in ("exp_avg", "exp_avg_sq")}
        yield phase, Frozen(stepper.parts, copy, adam, stop, state.densifier, *shots)


def shots_of(stepper: Stepper) -> tuple[list[Shot], list[Shot], list[Shot]]:
    """Return pairs of training views, single ones, and held-out ones over white."""
    parts, draws = stepper.parts, torch.Generator().manual_seed(1)
    embedding = parts.prior.embed(stepper.prompt, stepper.negative_prompt)

    def shot(cameras: Cameras, background: Tensor) -> Shot:
        condition = embedding.at(cameras, background)
        # Each prompt has a single mode, so that any image is nearest to it.
        truth = condition.nearest(torch.zeros(len(cameras), cameras.height, cameras.width, 3))
        assert truth is not None
        return Shot(cameras, background, condition, truth)

    def sample(views: int) -> Shot:
        return shot(parts.camera.sample(0, views, draws), parts.background.sample(views, draws))

    pairs, singles = [sample(2) for _ in range(STEPS)], [sample(1) for _ in range(VIEWS)]
    size = pairs[0].cameras.height
    rings = [turntable(8, elevation_deg=e, distance=3.1, fov_y_deg=42.5, size=size) for e in (0.0, 30.0)]
    return pairs, singles, [shot(ring, torch.ones(8, 3)) for ring in rings]


# --- the truth --------------------------------------------------------------------------------------------


def gains(frozen: Frozen, groups: int = GROUPS, partitions: int = PARTITIONS) -> list[Tensor]:
    """Return the gain of every Gaussian from the even and from the odd partitions, in squared error.

    Every Gaussian is refined once per partition. All moments of Adam begin at zero, because only newborns
    would otherwise move at full speed, and recover from the noise of training sooner than all others.
    """
    draws, adam = torch.Generator().manual_seed(0), frozen.parts.optimizer
    found = [torch.zeros(len(frozen.gaussians)), torch.zeros(len(frozen.gaussians))]
    for partition in range(partitions):
        label = torch.randperm(len(frozen.gaussians), generator=draws) % groups
        maps = []
        for group in range(groups):
            edit = frozen.refined(label == group, seed=partition * groups + group)
            maps.append(frozen.errors(frozen.tune(adam.start(edit.apply(frozen.gaussians)))))
        sums = frozen.blended(torch.stack(maps))
        refined = sums.gather(0, label[None])[0]
        found[partition % 2] += (sums.sum(0) - refined) / (groups - 1) - refined
    return [half * 2 / partitions for half in found]


def noise_free(frozen: Frozen) -> tuple[Tensor, Tensor]:
    """Return the mean norms of the plain and the absolute view-space gradient of the true squared error."""
    plain, absolute = torch.zeros(2, len(frozen.gaussians))
    for shot in frozen.singles:
        out = frozen.render(frozen.gaussians.map(lambda leaf: leaf.requires_grad_()), shot, True)
        (out.rgb - shot.truth).square().mean().backward()
        plain += out.means2d.grad[0].norm(dim=-1) / VIEWS
        absolute += out.absgrad.grad[0].norm(dim=-1) / VIEWS
    frozen.gaussians.map(lambda leaf: leaf.requires_grad_(False))
    return plain, absolute


def variance(frozen: Frozen) -> tuple[Tensor, Tensor, Tensor]:
    """Return the squared expected gradient of the means, and the variances between views and from noise."""
    draws, means = torch.Generator().manual_seed(2), frozen.gaussians.means.clone().requires_grad_()
    samples = []
    for shot in frozen.singles:
        rgb = frozen.render(replace(frozen.gaussians, means=means), shot).rgb
        for _ in range(NOISES):
            loss = frozen.parts.guidance(rgb, shot.condition, frozen.parts.prior, frozen.step, draws).loss
            samples += torch.autograd.grad(loss, means, retain_graph=True)
    each = torch.stack(samples).unflatten(0, (VIEWS, NOISES))
    noise, between = each.var(1).mean(0).sum(-1), each.mean(1).var(0).sum(-1)
    drift = each.mean((0, 1)).square().sum(-1) - between / VIEWS
    return drift, between - noise / NOISES, noise


# --- the criteria -----------------------------------------------------------------------------------------


def criteria(frozen: Frozen, expected: Tensor, exact: Tensor) -> dict[str, Tensor]:
    """Return what each criterion says of every Gaussian; more is said to need growth."""
    assert frozen.seen is not None
    assert isinstance(frozen.parts.densifier, Panel)
    cadam, sums = frozen.seen.cadam, frozen.seen.sums
    drift, noise = frozen.parts.densifier.cadam.strengths(cadam)
    magnitude, absgrad = (each / sums.sightings.clamp_min(1) for each in (sums.plain_sum, sums.norm_sum))
    error = frozen.errors(frozen.gaussians)
    error, footprint = frozen.blended(torch.stack([error, torch.ones_like(error)]))
    return {
        "random": torch.rand(len(drift), generator=torch.Generator().manual_seed(3)),
        "magnitude": magnitude,
        "absolute": absgrad,
        "drift": drift,
        "SNR": drift / noise,
        "both gates": drift * (drift > 0.1 * noise),
        "conflict ratio": 1 - magnitude / absgrad.clamp_min(TINY),
        "conflict": absgrad - magnitude,
        "radius": sums.radius,
        "footprint": footprint,
        "absolute x footprint": absgrad * footprint,
        "SNR x footprint": drift / noise * footprint,
        "error map": error,
        "expected drift": expected,
        "absolute, no noise": exact,
    }


def auc(scores: Tensor, wanted: Tensor) -> float:
    """Return the area under the ROC curve: how often a wanted row scores above another; ties count half."""
    ranks, is_wanted = rankdata(scores.numpy()), wanted.numpy()
    count = is_wanted.sum()
    return float((ranks[is_wanted].sum() - count * (count + 1) / 2) / (count * (len(ranks) - count)))


def auc_interval(scores: Tensor, wanted: Tensor) -> tuple[float, float, float]:
    """Return the area and its 95 % interval, from a bootstrap over Gaussians."""
    draws = np.random.default_rng(0)
    rows = [torch.from_numpy(draws.integers(len(scores), size=len(scores))) for _ in range(RESAMPLES)]
    low, high = np.quantile([auc(scores[r], wanted[r]) for r in rows], [0.025, 0.975])
    return auc(scores, wanted), float(low), float(high)


def top(scores: Tensor, share: float) -> Tensor:
    """Return the mask of the ``share`` of rows with the largest scores."""
    chosen = torch.zeros(len(scores), dtype=torch.bool)
    chosen[scores.topk(round(share * len(scores))).indices] = True
    return chosen


def psnr_after(frozen: Frozen, selected: Tensor, worth: str) -> tuple[float, int]:
    """Return the PSNR after refining ``selected`` and some more steps, and the count.

    ``mdb_noisy`` has steps of the run, with its moments of Adam, and ``mdb_exact`` those of the trials.
    """
    is_noisy = worth == "mdb_noisy"
    edit, owner = frozen.refined(selected, seed=4), frozen.parts.optimizer.start(frozen.gaussians)
    owner.load_state_dict(frozen.adam)
    owner.apply(edit)
    if not is_noisy:
        owner = frozen.parts.optimizer.start(owner.gaussians)
    errors = frozen.errors(frozen.tune(owner, noise_seed=4 if is_noisy else None))
    return float(-10 * (errors.mean((1, 2)) / 3).log10().mean()), edit.rows_after


def rows_of(frozen: Frozen) -> Iterator[dict[str, Any]]:
    """Yield one row per criterion; the last one is the gain itself, which finds itself without error."""
    even, odd = gains(frozen)
    gain, variances, (plain, absolute) = (even + odd) / 2, variance(frozen), noise_free(frozen)
    found = criteria(frozen, variances[0], absolute)
    seen = top(found["footprint"], 0.5)
    parts = [*(each / sum(variances) for each in variances), 1 - plain / absolute.clamp_min(TINY)]
    facts = dict(zip(PARTS, (float(part[seen].median()) for part in parts), strict=True))
    facts |= {"gaussians": len(gain), "reliability": float(np.corrcoef(even, odd)[0, 1])}
    best = float(odd[top(even, CHOSEN)].sum() + even[top(odd, CHOSEN)].sum()) / 2
    without = {column: psnr_after(frozen, torch.zeros_like(seen), column) for column in WORTH}
    for name, scores in (found | {"gain": gain}).items():
        row, chosen = {"criterion": name, **facts}, top(scores, CHOSEN)
        if name != "gain":
            row["captured"] = float(gain[chosen].sum()) / best
            row["auc_seen"] = auc(scores[seen], top(gain[seen], SHARE))
            row |= zip(("auc", "low", "high"), auc_interval(scores, top(gain, SHARE)), strict=True)
        for column, (before, count) in without.items():
            after, grown = psnr_after(frozen, chosen, column)
            row[column] = 1000 * (after - before) / max(grown - count, 1)
        yield row


# --- the rows, their table and their figure ---------------------------------------------------------------


def collect(path: Path) -> None:
    """Add the rows that the file lacks, first those of four objects."""
    rows = read(path)
    done = {(row["object"], row["noise"], row["phase"]) for row in rows}
    names = list(OBJECTS)
    runs = [(name, noise) for some in (names[:4], names[4:]) for noise in NOISE for name in some]
    for name, noise in runs:
        words, began = [*OBJECTS[name], f"noise={noise}", f"prompt={name}"], time.process_time()
        if {(name, noise, phase) for phase in PHASES} <= done:
            continue
        for phase, frozen in frozen_runs(words):
            world = "shapes" if OBJECTS[name] is BENCH else "objects"
            facts = {"object": name, "world": world, "phase": phase, "noise": noise, "seed": 0}
            facts |= {"commit": commit(), "machine": processor(), "threads": torch.get_num_threads()}
            added = [facts | row for row in rows_of(frozen)] if (name, noise, phase) not in done else []
            rows += [row | {"cpu_seconds": round(time.process_time() - began)} for row in added]
            write_csv(path, [COLUMNS, *([shown(row.get(key, "")) for key in COLUMNS] for row in rows)])
            began = time.process_time()


def read(path: Path) -> list[dict[str, Any]]:
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines())) if path.exists() else []


def shown(value: Any) -> str:
    return f"{value:.4f}" if isinstance(value, float) else str(value)


def pooled(rows: Rows, column: str, **where: str) -> tuple[float, float, float] | None:
    """Return the mean over objects and its 95 % interval, from a bootstrap of objects; None without rows."""
    by_object: dict[str, list[float]] = {}
    for row in rows:
        if row[column] != "" and all(row[key] == value for key, value in where.items()):
            by_object.setdefault(row["object"], []).append(float(row[column]))
    if not by_object:
        return None
    means = np.array([np.mean(values) for values in by_object.values()])
    draws = np.random.default_rng(0).choice(means, (2000, len(means))).mean(1)
    low, high = np.quantile(draws, [0.025, 0.975])
    return float(means.mean()), float(low), float(high)


def print_tables(rows: Rows) -> None:
    """Print the means of every criterion over objects and noise in Markdown, a table per phase."""

    def state(row: Mapping[str, Any]) -> tuple[str, ...]:
        return row["object"], row["noise"], row["phase"]

    drift = {state(row): float(row["mdb_noisy"]) for row in rows if row["criterion"] == "drift"}
    rows = [{**row, "over drift": float(row["mdb_noisy"]) - drift[state(row)]} for row in rows]
    columns = ("auc", "auc_seen", "captured", *WORTH, "over drift")
    for phase in PHASES:
        print(f"\n{phase}\n\n{header(['criterion', *columns])}")
        for name in dict.fromkeys(row["criterion"] for row in rows):
            found = [pooled(rows, column, phase=phase, criterion=name) for column in columns]
            print(
                line_of(
                    [
                        name,
                        *("-" if each is None else "{:.2f} ({:.2f}, {:.2f})".format(*each) for each in found),
                    ]
                )
            )


def draw(rows: Rows, path: Path) -> None:
    """Draw the area under the curve and the worth of every criterion, with intervals over objects."""
    names = list(dict.fromkeys(row["criterion"] for row in rows))
    with styled():
        figure = Figure(figsize=(10, 4.8), layout="constrained")
        for axes, (column, title) in zip(figure.subplots(1, 3, sharey=True), PANELS.items(), strict=True):
            for offset, (phase, color) in enumerate(zip(PHASES, COLORS, strict=False)):
                for row, name in enumerate(names):
                    mean, *ends = pooled(rows, column, phase=phase, criterion=name) or [np.nan] * 3
                    place, label = row + 0.3 * offset, f"step {PHASES[phase]}" if row == 0 else None
                    axes.plot(mean, place, "o", color=color, ms=4, label=label)
                    axes.plot(ends, [place, place], color=color, lw=1.5)
            axes.set_title(title)
        axes.set_yticks(range(len(names)), names)
        axes.invert_yaxis()
        axes.legend()
        figure.savefig(path, dpi=110)


def main() -> None:
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    collect(DATA)
    print_tables(read(DATA))
    draw(read(DATA), FIGURE)


if __name__ == "__main__":
    main()
