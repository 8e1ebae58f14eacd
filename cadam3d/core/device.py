"""Device: from the name that a user types to one that works here, and data on the way to it and back.

A host that does not wait for a CUDA device prepares the next kernels while the device computes.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from cadam3d.core.checks import fail


def resolve_device(name: str) -> torch.device:
    """Return the device ``name``: ``auto`` is CUDA if available, else the CPU; other names are torch's.

    Raises ``UserError`` for a name that torch does not know, or a device that this machine does not have or
    that cannot compute in float64, such as Apple's ``mps``.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        # Reading a value back also refuses "meta", a device without memory.
        torch.zeros(1, dtype=torch.float64, device=device).item()
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).strip().splitlines()[0]
        expected = f"a device of this machine with float64 ({reason})"
        raise fail("device", expected=expected, got=name, example="device=cpu") from error
    return device


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """Return ``tensor`` on ``device``, without waiting for what the device is doing.

    A copy from ordinary memory to CUDA would wait. From pinned memory it does not, and torch reuses that
    memory only after the copy. On the device that it is on already, a tensor is returned as it is. A copy to
    the CPU waits, because the host could otherwise read it before it is complete.
    """
    if device.type == "cuda" and tensor.device.type == "cpu":
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=device.type != "cpu")


def upload_together(tensors: Sequence[Tensor], device: torch.device) -> list[Tensor]:
    """Return all tensors on ``device``, sent there in one copy as :func:`upload` does.

    Those that are there already are returned as they are. The others are views of the copy, except that each
    tensor keeps its dtype.
    """
    away = [tensor for tensor in tensors if tensor.device != device]
    if not away:
        return list(tensors)
    flat = upload(torch.cat([tensor.reshape(-1) for tensor in away]), device)
    pieces = iter(flat.split([tensor.numel() for tensor in away]))
    return [
        tensor if tensor.device == device else next(pieces).view(tensor.shape).to(tensor.dtype)
        for tensor in tensors
    ]


def read_numbers(numbers: Sequence[Tensor | float], device: torch.device) -> list[float]:
    """Return the numbers, of which some may be tensors with one element. Waits for ``device`` once in all."""
    tensors = [
        upload(number.detach().reshape(()), device) for number in numbers if isinstance(number, Tensor)
    ]
    read = iter(torch.stack(tensors).tolist() if tensors else [])
    return [float(next(read) if isinstance(number, Tensor) else number) for number in numbers]
