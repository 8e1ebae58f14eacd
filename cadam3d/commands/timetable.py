"""Timetable: say before a run when it will grow, reset opacities and only optimise."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace

from cadam3d.core.schedule import Schedule, settled_at
from cadam3d.densifier.base import Densifier
from cadam3d.densifier.refine import Refine
from cadam3d.trainer import Trainer


def describe(trainer: Trainer) -> str:
    """Return the timetable of a run in one line: refinements, opacity resets, the steps after them, rates.

    It names resets that are skipped (:attr:`Refine.resets`) and schedules that the run does not complete. If
    no Gaussian can grow, it says so. If the refinements are made for another number of steps, it says how
    many that length has.
    """
    refine, densifier = trainer.refine, trainer.densifier
    rest, settled = _rest(refine, densifier), trainer.optimizer.settled_at()
    parts = [
        _counted("refinement", refine.refinements),
        *_resets(refine, densifier),
        *(["a last pruning"] if refine.last_max_scale is not None else []),
        f"the last {rest} of {refine.steps} steps only optimise" if rest else "the last step refines",
        "constant learning rates"
        if settled == 0
        else f"learning rates change until step {min(settled, refine.steps)}",
    ]
    sentences = [f"{', '.join(parts)}."]
    if later := [f"{key} (until step {end})" for key, end in _schedules(trainer) if end > refine.steps]:
        sentences.append(f"The run ends before these schedules do: {', '.join(later)}.")
    if refine.made_for not in (None, refine.steps):
        published = len(replace(refine, steps=refine.made_for).refinements)
        sentences.append(f"The refinements are made for {refine.made_for} steps, which have {published}.")
    if densifier.grows_from is not None and not any(
        step >= densifier.grows_from for step in refine.refinements[-1:]
    ):
        sentences.append(
            f"Nothing will grow, because no refinement follows step {densifier.grows_from}. "
            f"Try: refine.start=0 refine.end={refine.steps}"
        )
    return " ".join(sentences)


def _resets(refine: Refine, densifier: Densifier) -> Iterator[str]:
    """Yield the resets, and those that are skipped."""
    if not densifier.resets:
        yield "no opacity reset"
        return
    yield _counted("opacity reset", refine.resets)
    if refine.skipped_resets:
        verb = "is" if len(refine.skipped_resets) == 1 else "are"
        reason = f"less than refine.recovery={refine.recovery} steps before the end"
        yield f"{_counted('reset', refine.skipped_resets)} {verb} skipped ({reason})"


def _rest(refine: Refine, densifier: Densifier) -> int:
    """Return the number of steps after the last refinement and the last reset."""
    resets = refine.resets if densifier.resets else range(0)
    return refine.steps - max((*refine.refinements[-1:], *resets[-1:]), default=0)


def _schedules(trainer: Trainer) -> Iterator[tuple[str, int]]:
    """Yield the key of every schedule except learning rates, and the step from which it is constant."""
    parts = [(name, getattr(trainer, name)) for name in ("camera", "guidance", "densifier", "augmentation")]
    parts += [(f"regularizer.{name}", each) for name, each in trainer.regularizers.items()]
    for name, part in parts:
        for field in fields(part) if is_dataclass(part) else ():
            value = getattr(part, field.name)
            if isinstance(value, Schedule):
                yield f"{name}.{field.name}", settled_at(value)


def _counted(noun: str, steps: range) -> str:
    """Return a number of events and their steps, such as "2 resets (steps 300 and 450)"."""
    if len(steps) == 0:
        return f"no {noun}"
    if len(steps) == 1:
        return f"1 {noun} (step {steps[0]})"
    if len(steps) == 2:
        return f"2 {noun}s (steps {steps[0]} and {steps[1]})"
    return f"{len(steps)} {noun}s (steps {steps[0]} to {steps[-1]}, every {steps.step})"
