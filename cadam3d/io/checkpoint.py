"""Checkpoints: plain tensors, numbers and names in one file that appears whole or not at all.

The file is the archive of ``torch.save``: a ZIP of stored (not compressed) entries, of which one is a pickle
and each other one holds the bytes of a tensor. It is read by ``torch.load`` with ``weights_only=True``, which
executes nothing from a file. Torch does not verify the checksums of the archive and builds sparse or
quantized tensors too, so both are checked here.
"""

import io
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import torch
from torch import Tensor

from cadam3d.core.errors import UserError
from cadam3d.io.atomic import remove_leftovers, replacing
from cadam3d.io.pickled import require_finite
from cadam3d.io.reading import open_regular
from cadam3d.io.run_folder import checkpoint_step, checkpoints

FORMAT = "cadam3d-checkpoint"
# This number increases when old payloads can no longer be read.
VERSION = 2
DTYPES = (
    *(torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.bool),
    *(torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8),
)
PLAIN = (bool, int, float, str, type(None))

Content = TypeVar("Content")


class DamagedCheckpointError(UserError):
    """A file that is not a sound checkpoint; an older one of the same run may be."""

    def __init__(self, path: Path, reason: object) -> None:
        words = " ".join(str(reason).split())[:200] or type(reason).__name__
        super().__init__(f"{path}: cannot be read as a checkpoint ({words}). Try: resume=RUN of another run")


def save_checkpoint(path: Path, payload: Mapping[str, Any]) -> None:
    """Write ``payload`` (dicts, lists, tensors, numbers, strings, None) atomically.

    Raises ``UserError`` if the file cannot be written, and ``ValueError`` for a value that
    :func:`load_checkpoint` would refuse, because the error is better raised now than when the run is resumed.
    """
    content = {"format": FORMAT, "version": VERSION, "payload": _plain(payload)}
    _require_plain(content)
    # Written to memory first, because a full disk would cause an obscure error in torch's archive writer.
    buffer = io.BytesIO()
    torch.save(content, buffer)
    with replacing(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def load_checkpoint(path: Path) -> Any:
    """Return the payload on the CPU, without executing anything from the file.

    Only the container is checked here: ``TrainState.restore`` checks the entries. Raises
    ``DamagedCheckpointError`` if the file is missing, damaged (checksums are verified), not a checkpoint of
    cadam3d or of another version.
    """
    # A damaged archive or pickle makes its readers raise almost anything.
    try:
        with open_regular(path) as file:
            _require_sound(file)
            require_finite(file)
            file.seek(0)
            content = torch.load(file, map_location="cpu", weights_only=True)
        _require_plain(content)
        if (content["format"], content["version"]) != (FORMAT, VERSION):
            raise ValueError(f"its version is not {VERSION}, which this cadam3d reads")
        return content["payload"]
    except Exception as error:
        raise DamagedCheckpointError(path, error) from error


def latest_checkpoint(
    folder: Path, read: Callable[[Path], Content], on_damage: Callable[[UserError], None]
) -> tuple[Path, Content] | None:
    """Return the newest sound checkpoint in ``folder`` and its content; None if there is no checkpoint.

    ``read`` returns the content of a file or raises ``DamagedCheckpointError``, and ``on_damage`` is called
    with the error of each file that is left out. Raises ``UserError`` if all files are damaged, because
    starting again silently would hide the loss.
    """
    problems: list[UserError] = []
    for path in reversed(checkpoints(folder)):
        try:
            content = read(path)
        except DamagedCheckpointError as error:
            problems.append(error)
            continue
        for problem in problems:
            on_damage(problem)
        return path, content
    if problems:
        raise problems[0]
    return None


def drop_after(folder: Path, step: int) -> None:
    """Delete the checkpoints in ``folder`` of steps after ``step``."""
    for path in checkpoints(folder):
        if (checkpoint_step(path) or 0) > step:
            path.unlink(missing_ok=True)


def prune_checkpoints(folder: Path, *, keep: int) -> None:
    """Delete all but the ``keep`` newest checkpoints in ``folder``, and half-written ones of killed runs."""
    remove_leftovers(folder)
    for path in checkpoints(folder)[:-keep]:
        path.unlink(missing_ok=True)


def _require_sound(file: BinaryIO) -> None:
    """Raise an exception unless ``file`` is an archive whose entries are in the file as they were written."""
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        # A compressed entry could be a thousand times as large as the file, and so could those that overlap.
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise ValueError("it is compressed")
        if sum(entry.file_size for entry in entries) > file.seek(0, io.SEEK_END):
            raise ValueError("its entries are larger than the file")
        if archive.testzip() is not None:
            raise ValueError("a checksum does not match")


def _require_plain(content: Any) -> None:
    """Raise ``ValueError`` unless ``content`` consists of plain data and of dense tensors."""
    seen, rest = set(), [content]
    while rest:
        value = rest.pop()
        if isinstance(value, Tensor):
            if not _is_plain_tensor(value):
                raise ValueError("it holds a tensor that is not plain")
        elif type(value) in (dict, list, tuple):
            # Few lines of a pickle can describe a huge tree of containers that appear many times in it.
            if id(value) not in seen:
                rest += [*value, *value.values()] if isinstance(value, dict) else value
            seen.add(id(value))
        elif type(value) not in PLAIN:
            raise ValueError(f"it holds something other than plain data: {type(value).__name__}")


def _is_plain_tensor(tensor: Tensor) -> bool:
    """Return whether a tensor is one that :func:`save_checkpoint` could have written."""
    if tensor.layout != torch.strided or tensor.device.type != "cpu" or tensor.dtype not in DTYPES:
        return False
    is_dense = tensor.is_contiguous() and tensor.untyped_storage().nbytes() == tensor.nbytes
    if not is_dense or tensor.requires_grad:
        return False
    # Torch calculates nonsense with truth values that are neither 0 nor 1.
    return tensor.dtype != torch.bool or not bool((tensor.view(torch.uint8) > 1).any())


def _plain(value: Any) -> Any:
    """Return ``value`` with tensors on the CPU and without hidden storage."""
    if isinstance(value, Tensor):
        tensor = value.detach().cpu().contiguous()
        is_view = tensor.untyped_storage().nbytes() != tensor.nbytes
        # Torch would save the whole storage of a view.
        return tensor.clone() if is_view else tensor
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_plain(item) for item in value)
    return value
