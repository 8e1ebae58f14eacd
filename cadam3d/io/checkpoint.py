"""Checkpoints: plain tensors, numbers and names in one file that appears whole or not at all."""

import io
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cadam3d.core.errors import UserError
from cadam3d.io.atomic import remove_leftovers, replacing
from cadam3d.io.run_folder import CHECKPOINT_PATTERN, checkpoint_name

FORMAT = "cadam3d-checkpoint"
# This number increases when old payloads can no longer be read.
VERSION = 1


def save_checkpoint(path: Path, payload: Mapping[str, Any]) -> None:
    """Write ``payload`` (dicts, lists, tensors, numbers, strings, None) atomically.

    Raises ``UserError`` if the file cannot be written, and ``TypeError`` for a value that a safe load would
    refuse, because the error is better raised now than when the run is resumed.
    """
    content = {"format": FORMAT, "version": VERSION, "payload": _plain(payload)}
    # Written to memory first, because a full disk would cause an obscure error in torch's archive writer.
    buffer = io.BytesIO()
    torch.save(content, buffer)
    with replacing(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Return the payload on the CPU, without executing anything from the file (``weights_only``).

    Raises ``UserError`` if the file is missing, damaged (checksums are verified), not a checkpoint of cadam3d
    or of another version.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such checkpoint. Try: resume=RUN with the folder of a run")
    try:
        # torch.load does not compare the checksums of the archive, so it would not notice a flipped bit.
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        if damaged is not None:
            raise zipfile.BadZipFile(f"checksum of {damaged} does not match")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (zipfile.BadZipFile, pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise UserError(
            f"{path}: cannot be read as a checkpoint ({reason}). "
            "Try: another file of the same folder, as in resume=RUN/checkpoints/step_0000100.pt"
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise UserError(f"{path}: not a cadam3d checkpoint. Try: resume=RUN with the folder of a run")
    if content["version"] != VERSION:
        raise UserError(
            f"{path}: checkpoint version {content['version']}, this cadam3d reads {VERSION}. "
            "Try: resume with the cadam3d that wrote it (see summary.json)"
        )
    return content["payload"]


def latest_checkpoint(folder: Path) -> Path | None:
    """Return the newest sound checkpoint in ``folder``; None if the folder has no checkpoint at all.

    Raises ``UserError`` if all files are damaged, because starting again silently would hide the loss.
    """
    paths = sorted(folder.glob(CHECKPOINT_PATTERN), reverse=True)
    problem: UserError | None = None
    for path in paths:
        try:
            load_checkpoint(path)
        except UserError as error:
            problem = problem or error
        else:
            return path
    if problem is not None:
        raise problem
    return None


def drop_after(folder: Path, step: int) -> None:
    """Delete the checkpoints in ``folder`` of steps after ``step``."""
    for path in folder.glob(CHECKPOINT_PATTERN):
        if path.name > checkpoint_name(step):
            path.unlink(missing_ok=True)


def prune_checkpoints(folder: Path, *, keep: int) -> None:
    """Delete all but the ``keep`` newest checkpoints in ``folder``, and half-written ones of killed runs."""
    remove_leftovers(folder)
    for path in sorted(folder.glob(CHECKPOINT_PATTERN))[:-keep]:
        path.unlink(missing_ok=True)


def _plain(value: Any) -> Any:
    """Return ``value`` with tensors on the CPU and without hidden storage; refuse what is not plain data."""
    if isinstance(value, Tensor):
        tensor = value.detach().cpu().contiguous()
        is_view = tensor.untyped_storage().nbytes() != tensor.nbytes
        # Torch would save the whole storage of a view.
        return tensor.clone() if is_view else tensor
    if isinstance(value, Mapping):
        return {_plain_key(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_plain(item) for item in value)
    if value is None or type(value) in (bool, int, float, str, bytes):
        return value
    raise TypeError(f"a checkpoint holds plain data only, not {type(value).__name__}")


def _plain_key(key: object) -> object:
    if type(key) not in (str, int):
        raise TypeError(f"keys of a checkpoint are strings or integers, not {type(key).__name__}")
    return key
