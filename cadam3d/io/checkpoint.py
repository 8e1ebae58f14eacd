"""Checkpoints: plain tensors, numbers and names in one file that appears whole or not at all.

The file is the archive of ``torch.save``: a ZIP of stored (not compressed) entries, of which one is a pickle
and each other one holds the bytes of a tensor. It is not read with ``torch.load``, whose safe mode still
builds sparse, quantized or enormous tensors if a file asks for them. The small reader in this module knows
only what :func:`save_checkpoint` writes, so no other thing can come out of a file, and it never allocates
more than the size of the file.
"""

import io
import pickle
import sys
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor

from cadam3d.core.errors import UserError
from cadam3d.io.atomic import remove_leftovers, replacing
from cadam3d.io.reading import open_regular
from cadam3d.io.run_folder import checkpoint_step, checkpoints

FORMAT = "cadam3d-checkpoint"
# This number increases when old payloads can no longer be read.
VERSION = 1
PICKLE = "data.pkl"
LARGEST_PICKLE = 1 << 20  # bytes; that of a run has some three thousand
# What the pickle may name: the storages of dense tensors, by the type of their numbers.
DTYPES = {
    "FloatStorage": torch.float32,
    "DoubleStorage": torch.float64,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}
# The operations of pickle that write dicts, lists, tuples, numbers, text and tensors, and no others.
OPERATIONS = (
    *(pickle.PROTO, pickle.STOP, pickle.MARK, pickle.NONE, pickle.NEWTRUE, pickle.NEWFALSE),
    *(pickle.BININT, pickle.BININT1, pickle.BININT2, pickle.LONG1, pickle.BINFLOAT, pickle.BINUNICODE),
    *(pickle.EMPTY_DICT, pickle.SETITEM, pickle.SETITEMS, pickle.EMPTY_LIST, pickle.APPEND, pickle.APPENDS),
    *(pickle.EMPTY_TUPLE, pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3),
    *(pickle.BINPUT, pickle.LONG_BINPUT, pickle.BINGET, pickle.LONG_BINGET),
    *(pickle.GLOBAL, pickle.REDUCE, pickle.BINPERSID),
)

Content = TypeVar("Content")


class DamagedCheckpointError(UserError):
    """A file that is not a sound checkpoint; an older one of the same run may be."""

    def __init__(self, path: Path, reason: object) -> None:
        words = " ".join(str(reason).split())[:200] or type(reason).__name__
        super().__init__(f"{path}: cannot be read as a checkpoint ({words}). Try: {_another(path)}")


def save_checkpoint(path: Path, payload: Mapping[str, Any]) -> None:
    """Write ``payload`` (dicts, lists, tensors, numbers, strings, None) atomically.

    Raises ``UserError`` if the file cannot be written, and ``TypeError`` for a value that
    :func:`load_checkpoint` would refuse, because the error is better raised now than when the run is resumed.
    """
    content = {"format": FORMAT, "version": VERSION, "payload": _plain(payload)}
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
    # A damaged archive or pickle makes the readers of Python raise almost anything.
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            content = _read(archive, size=file.seek(0, io.SEEK_END))
    except FileNotFoundError as error:
        raise DamagedCheckpointError(path, "no such checkpoint") from error
    except UserError as error:
        raise DamagedCheckpointError(path, "it is not a regular file") from error
    except Exception as error:
        is_flipped = isinstance(error, zipfile.BadZipFile) and "CRC" in str(error)
        reason = "a checksum does not match" if is_flipped else error
        raise DamagedCheckpointError(path, reason) from error
    if type(content) is not dict or set(content) != {"format", "version", "payload"}:
        raise DamagedCheckpointError(path, "not a cadam3d checkpoint")
    if type(content["format"]) is not str or content["format"] != FORMAT:
        raise DamagedCheckpointError(path, "not a cadam3d checkpoint")
    version = content["version"]
    if type(version) is not int or version != VERSION:
        written = str(version)[:20] if isinstance(version, int) and abs(version) < 10**9 else "unknown"
        raise DamagedCheckpointError(path, f"version {written}, this cadam3d reads {VERSION}")
    return content["payload"]


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
        else:
            for problem in problems:
                on_damage(problem)
            return path, content
    if problems:
        reason = str(problems[0]).partition(" Try: ")[0]
        raise UserError(f"{reason} No other checkpoint there is sound. Try: a new run, without resume=...")
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


def _read(archive: zipfile.ZipFile, size: int) -> Any:
    """Return what the pickle of an archive describes. Raises any exception if the archive is damaged."""
    entries = archive.infolist()
    # A compressed entry could be a thousand times as large as the file, and so could entries that overlap.
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise ValueError("it is compressed")
    if sum(entry.file_size for entry in entries) > size:
        raise ValueError("its entries are larger than the file")
    # Reading an entry to its end compares its checksum.
    for entry in entries:
        if not entry.filename.endswith(f"/{PICKLE}") and "/data/" not in entry.filename:
            archive.read(entry)
    (name,) = (entry.filename for entry in entries if entry.filename.endswith(f"/{PICKLE}"))
    root = name.removesuffix(PICKLE)
    order = archive.read(f"{root}byteorder").decode("ascii")
    if order != sys.byteorder:
        raise ValueError(f"it was written on a computer with {order} numbers")
    if archive.getinfo(name).file_size > LARGEST_PICKLE:
        raise ValueError("its description is too large")
    return _Reader(archive, root).load()


class _Reader(pickle._Unpickler):  # the pickle module's reader in Python, whose operations can be restricted
    """Reads the pickle of a checkpoint. No name in it leads to code, except to that of this class."""

    dispatch: ClassVar = {code[0]: pickle._Unpickler.dispatch[code[0]] for code in OPERATIONS}

    def __init__(self, archive: zipfile.ZipFile, root: str) -> None:
        super().__init__(io.BytesIO(archive.read(root + PICKLE)))
        self._archive = archive
        self._root = root
        self._storages: dict[str, Tensor] = {}

    def find_class(self, module: str, name: str) -> Any:
        """Return a number type, or the function of this class that replaces what the pickle names."""
        if module == "torch" and name in DTYPES:
            return DTYPES[name]
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return self._tensor
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        raise ValueError(f"it holds something other than plain data: {module[:80]}.{name[:80]}")

    def persistent_load(self, pid: Any) -> Tensor:
        """Return the numbers of one entry of the archive as a vector."""
        kind, dtype, key, device, count = pid
        if (kind, device) != ("storage", "cpu") or not key.isdecimal():
            raise ValueError("it holds a storage of another kind")
        if key not in self._storages:
            content = bytearray(self._archive.read(f"{self._root}data/{key}"))
            if dtype is torch.bool and content.translate(None, b"\0\1"):
                raise ValueError("it holds truth values that are neither true nor false")
            # torch.frombuffer refuses an empty buffer.
            empty = torch.empty(0, dtype=dtype)
            self._storages[key] = torch.frombuffer(content, dtype=dtype) if content else empty
        if len(self._storages[key]) != count or self._storages[key].dtype != dtype:
            raise ValueError("the size of a tensor is not that of its numbers")
        return self._storages[key]

    def _tensor(self, storage: Tensor, *layout: Any) -> Tensor:
        """Return a dense tensor that uses all numbers of ``storage`` in their order."""
        offset, size, strides, requires_grad, hooks = layout
        tensor = storage.view(torch.Size(size))
        # The stride along an axis of length 1 has no meaning.
        wanted = zip(size, tensor.stride(), strides, strict=True)
        is_dense = tensor.numel() == 0 or all(length == 1 or a == b for length, a, b in wanted)
        if offset != 0 or not is_dense or requires_grad is not False or hooks:
            raise ValueError("it holds a tensor that is not plain")
        return tensor


def _another(path: Path) -> str:
    """Return what to type instead of a damaged checkpoint."""
    others = [other for other in checkpoints(path.parent) if other.name != path.name]
    return f"resume={others[-1]}" if others else "resume=RUN with the folder of another run"


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
    if value is None or type(value) in (bool, int, float, str):
        return value
    raise TypeError(f"a checkpoint holds plain data only, not {type(value).__name__}")


def _plain_key(key: object) -> object:
    if type(key) not in (str, int):
        raise TypeError(f"keys of a checkpoint are strings or integers, not {type(key).__name__}")
    return key
