"""Growth: the snapshots of a run that its page contains, to turn the object and to watch it grow."""

from dataclasses import dataclass
from pathlib import Path

from cadam3d.core.errors import UserError
from cadam3d.io.html import encoded
from cadam3d.io.ply import read_ply
from cadam3d.io.reading import read_bytes
from cadam3d.io.run_folder import ASSET, has_file, snapshots
from cadam3d.viewer.pack import pack

LARGEST = 8 << 20  # bytes of all snapshots in a page; base64 makes a third more of them


@dataclass(frozen=True)
class ShownSnapshot:
    """One snapshot, as text of a page."""

    step: int
    data: str  # base64


def frames(folder: Path, steps: int) -> list[ShownSnapshot]:
    """Return snapshots of the run in ``folder``, in order; the last one is the object after ``steps`` steps.

    They have at most ``LARGEST`` bytes together. If there are more, every second of them is left out, or two
    of three, and so on, but never the last one. The result is empty if nothing can be read, or if the last
    one alone is too large.
    """
    paths = {step: path for step, path in snapshots(folder).items() if step <= steps}
    try:
        found = {step: read_bytes(path, largest=LARGEST) for step, path in paths.items()}
        if steps not in found and has_file(folder, ASSET):
            found[steps] = pack(read_ply(folder / ASSET))
    except UserError:
        # A file that cannot be read costs the picture, not the report.
        return []
    if steps not in found:
        return []
    backwards = sorted(found, reverse=True)
    for stride in range(1, len(backwards) + 1):
        kept = sorted(backwards[::stride])
        if sum(len(found[step]) for step in kept) <= LARGEST:
            return [ShownSnapshot(step, encoded(found[step])) for step in kept]
    return []
