"""TensorBoard: write event files, which ``tensorboard --logdir`` shows."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from cadam3d.callback.tracking import Tracking
from cadam3d.io.image import read_png
from cadam3d.io.reading import read_yaml
from cadam3d.io.run_folder import CONFIG, OVERRIDES, TENSORBOARD
from cadam3d.state import RunContext

FLUSH_SECONDS = 10


@dataclass(kw_only=True)
class TensorBoard(Tracking):
    """Write ``tensorboard/`` into the folder of the run: curves, previews, settings and final numbers.

    All settings are one text. The settings that were typed and the final numbers are also a row of the tab
    HParams, which compares the jobs of a sweep.
    """

    package: ClassVar[str] = "tensorboard"

    # A SummaryWriter, whose package may be missing.
    _writer: Any = field(default=None, init=False, repr=False)

    def open(self, context: RunContext, step: int) -> None:
        """Begin another event file. TensorBoard then ignores the steps after ``step`` in older files."""
        from torch.utils.tensorboard import SummaryWriter

        folder = context.folder / TENSORBOARD
        self._writer = SummaryWriter(str(folder), purge_step=step + 1, flush_secs=FLUSH_SECONDS)
        settings = (context.folder / CONFIG).read_text(encoding="utf-8")
        # Four spaces make a block of code in Markdown.
        block = "".join(f"    {line}\n" for line in settings.splitlines())
        self._writer.add_text(CONFIG, block, step)

    def record(self, step: int, numbers: Mapping[str, float], preview: Path | None) -> None:
        """Write scalars and a picture."""
        for name, number in numbers.items():
            self._writer.add_scalar(name, number, step)
        if preview is not None:
            self._writer.add_image("preview", read_png(preview), step, dataformats="HWC")
        # A run that is killed continues at its checkpoint, and does not record earlier steps again.
        self._writer.flush()

    def conclude(self, context: RunContext, step: int, results: Mapping[str, float]) -> None:
        """Write the final numbers as scalars, and as the row of the run in the tab HParams."""
        from torch.utils.tensorboard.summary import hparams

        self.record(step, results, None)
        typed = dict(line.lstrip("+~").partition("=")[::2] for line in read_yaml(context.folder / OVERRIDES))
        for summary in hparams(typed, dict(results)):
            self._writer.file_writer.add_summary(summary)

    def close(self, *, is_complete: bool) -> None:
        """Write what is left."""
        self._writer.close()
