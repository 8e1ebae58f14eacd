"""ProgressExporter: a video of a training, from the pictures that it has left."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from jaxtyping import UInt8

from cadam3d.core.checks import Count, one_of, within
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.core.rendering import RenderFn
from cadam3d.exporter.base import Exporter
from cadam3d.io.caption import Caption, side_by_side
from cadam3d.io.image import read_png, step_pictures
from cadam3d.io.records import counts, read_metrics
from cadam3d.io.run_folder import PREVIEWS, shown, typed_path
from cadam3d.io.video import CODECS, FORMATS, write_video

LONGEST_HOLD = 60  # seconds


@dataclass(frozen=True, kw_only=True)
class ProgressExporter(Exporter):
    """Write ``progress.mp4``, ``.webm`` or ``.gif``: the previews of a run with the step and the count."""

    files: ClassVar = ("progress.mp4", "progress.webm", "progress.gif")
    suffix_setting: ClassVar = "codec"
    yields: ClassVar = True

    # The folder of the run; None: the folder to which this exporter writes. A list of runs, which render
    # compares, has no single folder, and ``compare`` refuses it.
    run: str | Sequence[str] | None
    fps: Count  # previews per second
    hold: Annotated[float, within(low=0, high=LONGEST_HOLD)]  # seconds that the last preview stays
    codec: Annotated[str, one_of(CODECS)]

    def __post_init__(self) -> None:
        super().__post_init__()
        most = FORMATS[f".{self.codec}"].most_fps
        self.expect(self.fps <= most, "fps", f"at most {most} with codec={self.codec}", most)

    def export(self, gaussians: Gaussians, render: RenderFn, folder: Path) -> list[Path]:
        """Read the previews one by one and encode them; the Gaussians are not rendered."""
        run = typed_path(self.run) if isinstance(self.run, str) else folder
        pictures = step_pictures(run / PREVIEWS)
        if not pictures:
            raise UserError(
                f"{shown(run)}: has no {PREVIEWS}/. Try: cadam3d train callback.previews.every=20"
            )
        path = folder / self.file_name
        write_video(path, self._frames(pictures, counts(read_metrics(run))), fps=self.fps)
        return [path]

    def _frames(
        self, pictures: Sequence[tuple[int, Path]], counts: Sequence[tuple[int, float]]
    ) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        frame = None
        for step, path in pictures:
            picture = read_png(path)
            if frame is None:
                shape = picture.shape
            # The size of previews may differ if the run was resumed with another one.
            caption = Caption(f"step {step:,}", count_at(step, counts))
            frame = side_by_side([fitted(picture, shape)], [caption])
            yield frame
        assert frame is not None, "there is at least one picture"
        for _ in range(round(self.hold * self.fps)):
            yield frame


def count_at(step: int, counts: Sequence[tuple[int, float]]) -> str:
    """Return the number of Gaussians after ``step`` as text; "" if the log does not have it."""
    earlier = [count for at, count in counts if at <= step]
    return f"{earlier[-1]:,.0f} Gaussians" if earlier else ""


def fitted(picture: UInt8[np.ndarray, "h w 3"], shape: tuple[int, ...]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Return ``picture`` cut, or padded with white on the right and below, to the size ``shape``."""
    height, width = shape[:2]
    cut = picture[:height, :width]
    rest = ((0, height - cut.shape[0]), (0, width - cut.shape[1]), (0, 0))
    return np.pad(cut, rest, constant_values=255)
