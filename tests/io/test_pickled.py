"""A pickle that describes something endless is refused before it is built."""

import io
import zipfile
from pathlib import Path

import pytest
import torch

from cadam3d.core.errors import UserError
from cadam3d.io.checkpoint import load_checkpoint
from cadam3d.io.pickled import require_finite
from cadam3d.io.pretrained import read_tensors

# A dict with the tuple on the stack as its key, in a pickle of protocol 2.
BEGIN, END = b"\x80\x02}", b"K\x01s."
MEMO = b"q\x00h\x00\x86"  # remember the top, take it again, and make a tuple of both
KEY = b"(" + b"K\x01" * 9_000 + b"tq\x00"  # a tuple of 9000 numbers, remembered
BOMBS = {
    "duplicates": BEGIN + b")" + b"2\x86" * 60 + END,
    "memories": BEGIN + b")" + MEMO * 60 + END,
    "a deep tuple": BEGIN + b")" + b"\x85" * 1_000_000 + END,
    "deep lists": b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b".",
    "one large key for many dicts": b"\x80\x02" + KEY + b"0}h\x00K\x01s" * 9_000 + b".",
    "between marks": BEGIN + b")" + b"q\x00(h\x00h\x00h\x00t" * 60 + END,
}


def archive(folder: Path, content: bytes) -> Path:
    """Write a file of torch whose pickle is ``content``."""
    with zipfile.ZipFile(folder / "step_0000001.pt", "w") as file:
        for name, part in (("data.pkl", content), ("byteorder", b"little"), ("version", b"3\n")):
            file.writestr(f"archive/{name}", part)
    return folder / "step_0000001.pt"


@pytest.mark.parametrize("name", BOMBS)
def test_an_endless_pickle_is_one_message_wherever_torch_reads(name, tmp_path):
    path = archive(tmp_path, BOMBS[name])
    with pytest.raises(UserError, match=r"cannot be read as a checkpoint .*repeat each other"):
        load_checkpoint(path)
    with pytest.raises(UserError, match=r"not a file of tensors .*repeat each other"):
        read_tensors("prior.path", path)


@pytest.mark.parametrize("is_new", [True, False])
def test_what_torch_writes_is_finite(is_new, tmp_path):
    weight = torch.nn.Parameter(torch.ones(3, 4))
    layers = torch.nn.Sequential(*(torch.nn.Linear(2, 2) for _ in range(50)))
    content = {"weights": layers.state_dict(), "tied": [weight] * 100, "numbers": list(range(5000))}
    buffer = io.BytesIO()
    torch.save(content, buffer, _use_new_zipfile_serialization=is_new)
    require_finite(buffer)
