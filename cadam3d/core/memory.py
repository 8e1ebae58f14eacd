"""Memory: refuse sizes that no allocation can satisfy, and recognise the exceptions of those that failed."""

import os

import torch

from cadam3d.core.checks import fail

GIB = 2**30
# Bytes of a pixel: colour, alpha and depth in single precision.
PIXEL = 20
# Bytes of a camera: two matrices, two angles.
CAMERA = 100
# torch's wording, whose CPU allocator raises a plain RuntimeError.
CPU_FAILURES = ("can't allocate memory", "not enough memory", "Storage size calculation overflowed")


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether memory ran out."""
    if isinstance(error, torch.OutOfMemoryError | MemoryError):
        return True
    return isinstance(error, RuntimeError) and any(text in str(error) for text in CPU_FAILURES)


def require_memory(key: str, value: int, *, unit: float, power: int = 1) -> None:
    """Raise ``UserError`` if ``unit * value**power`` bytes are more than this machine has.

    ``unit`` is a lower bound of what the value needs. So a size that is accepted may still be too large, but
    one that is refused cannot work. The larger of main memory and GPU memory counts.
    """
    # Without a limit of the power, a huge value would be slow to compute.
    needed = unit * float(min(value, 2**63)) ** power
    if needed <= _total_bytes(with_gpu=False) or needed <= (total := _total_bytes(with_gpu=True)):
        return
    largest = int((total / unit) ** (1 / power))
    expected = f"at most {largest}, since this machine has {total / GIB:.0f} GiB of memory"
    raise fail(key, expected=expected, got=value)


def _total_bytes(*, with_gpu: bool) -> float:
    """Return the size of main memory, or of the largest GPU if that has more. It is infinite if unknown."""
    try:
        total = float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not every system has these names
        return float("inf")
    if with_gpu and torch.cuda.is_available():
        devices = range(torch.cuda.device_count())
        total = max([total, *(torch.cuda.get_device_properties(device).total_memory for device in devices)])
    return total
