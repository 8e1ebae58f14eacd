"""Training from Python: ``train`` does what ``cadam3d train`` does, and returns the run that it has made."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Unpack

from cadam3d.api.asset import Asset, load
from cadam3d.api.components import Components, given_objects, record_objects
from cadam3d.api.guest import as_guest, hinting, in_python, literal, require_free, stop_signals
from cadam3d.callback.base import Callback
from cadam3d.commands.opened import find_run
from cadam3d.commands.train import optimise
from cadam3d.core.signals import StopOnSignal
from cadam3d.io.records import read_config, read_metrics, read_summary
from cadam3d.io.run_folder import CONFIG, REPORT, RUN_FOLDER, shown
from cadam3d.launch import completing, prepare
from cadam3d.settings.line import continuing


class Run:
    """A run: the results in a folder that ``cadam3d train`` or :func:`train` has written.

    Everything is read from the files when it is asked for, so that a run that still trains shows its present
    state, and a run of last week can be opened with ``Run("outputs/latest")``.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        """Open the run in ``folder``. Raises ``UserError`` if the folder does not hold a run."""
        with hinting(has_words=False):
            self.folder: Path = find_run(os.fspath(folder))

    def __fspath__(self) -> str:
        """Return the folder, so that a run can stand for it: ``cadam3d.load(run)``."""
        return str(self.folder)

    @property
    def summary(self) -> dict[str, Any]:
        """Return the facts of ``summary.json``, such as ``num_gaussians`` and ``psnr``; {} before the end."""
        return read_summary(self.folder)

    @property
    def metrics(self) -> list[dict[str, Any]]:
        """Return the rows of ``metrics.jsonl``, oldest first.

        Each has a ``kind`` (``"step"`` or ``"refine"``) and a ``step``. Rows of steps have ``loss``,
        ``num_gaussians`` and ``seconds``; rows of refinements have the counts of what was changed.
        """
        return read_metrics(self.folder)

    @property
    def config(self) -> dict[str, Any]:
        """Return all settings of the run as plain nested dicts, resolved."""
        return read_config(self.folder / CONFIG)

    @property
    def asset(self) -> Asset:
        """Return the asset. Raises ``UserError`` if the run has written none."""
        return load(self.folder)

    @property
    def report(self) -> Path:
        """Return the path of the page with the object, charts and numbers, which training writes last."""
        return self.folder / REPORT

    def resume(
        self, *overrides: str, callbacks: Sequence[Callback] = (), **components: Unpack[Components]
    ) -> "Run":
        """Continue the run in its folder, with changed settings such as ``"steps=900"``; see ``train``."""
        require_free(overrides, {"resume": self.folder})
        line = (literal("resume", str(self.folder)), *overrides)
        return train(None, *line, callbacks=callbacks, **components)

    def __repr__(self) -> str:
        summary = self.summary
        facts = [repr(summary.get("prompt", self.config.get("prompt")))]
        if "outcome" in summary:
            facts.append(f"{summary['outcome']} after {summary.get('steps')} steps")
            facts.append(f"{summary.get('num_gaussians')} Gaussians")
        else:
            facts.append("not finished")
        return f"<Run {shown(self.folder)}: {', '.join(facts)}>"


def train(
    prompt: str | None,
    *overrides: str,
    callbacks: Sequence[Callback] = (),
    folder: str | os.PathLike[str] | None = None,
    **components: Unpack[Components],
) -> Run:
    """Train an asset for ``prompt``, and return the run.

    This is ``cadam3d train prompt=... OVERRIDES``, with the same settings, checks, files and bytes. The
    prompt may contain quotes, commas, braces and line breaks. ``overrides`` are the words of the command
    line, such as ``"steps=300"`` or ``"densifier=baseline"``, without quotes for a shell. ``folder`` is the
    folder of the run, by default a new one in ``outputs``; ``${seed}`` in it is the value of that setting.
    ``callbacks`` are called after the settings' own. To continue a run, pass ``"resume=FOLDER"`` and
    ``None`` as the prompt, or call :meth:`Run.resume`.

    Every other argument is an object that replaces the component of this name, such as ``densifier=``. The
    settings of the run record its class and its fields. Pass it again when the run continues.

    Raises ``UserError`` for mistakes, with the texts of the command line and hints in Python. After Ctrl-C,
    or the interrupt of a notebook, the run saves everything as on the command line, and then
    ``KeyboardInterrupt`` is raised. A second one stops at once. Messages go to the logger
    ``cadam3d.messages``.
    """
    named = {} if prompt is None else {"prompt": prompt}
    named |= {} if folder is None else {RUN_FOLDER: os.fspath(folder)}
    require_free(overrides, named)
    # Hydra resolves references in the name of the folder, even quoted ones, so they are not quoted.
    words = [
        f"{key}={text}" if key == RUN_FOLDER and "${" in text else literal(key, text)
        for key, text in named.items()
    ]
    words += overrides
    stop = StopOnSignal(stop_signals())
    with as_guest(), completing():
        given = given_objects(components, overrides)
        cfg, call = prepare("train", words)
        record_objects(cfg, call, given)
        folder, _ = optimise(cfg, call, stop, callbacks, given)
    if stop.received is not None:
        raise KeyboardInterrupt(f"Everything is saved. Continue with: {in_python(continuing(folder))}")
    return Run(folder)
