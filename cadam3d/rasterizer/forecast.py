"""Forecast: how many slots the next render needs, so that memory is reserved without waiting for a count."""

import ctypes
from functools import cache

import torch

# More slots are reserved than any recent render needed, by this factor.
MARGIN = 1.25
# The weight of a render decreases with every later one. After 700 of them it is a half.
DECAY = 0.999
# The smallest number of slots that is reserved. They take less memory than a small image.
LEAST = 4096


class Forecast:
    """Predicts the slots of a render from earlier renders of the same size.

    Kernels write what they have counted to ``report``, in pinned memory, which a device can write and the
    host can read at any time. So the host never waits, and learns from a render as soon as it has been
    counted.
    """

    def __init__(self, device: torch.device) -> None:
        # The number of Gaussians in the upper half, of slots in the lower half; 0 before any report.
        self.report = torch.zeros(1, dtype=torch.int64, device="cpu", pin_memory=device.type == "cuda")
        self._reported = ctypes.c_uint64.from_address(self.report.data_ptr())
        # The largest recent number of slots per Gaussian, and the latest number of Gaussians.
        self._density, self._gaussians = 0.0, 0

    def learn(self, slots: int, gaussians: int) -> None:
        """Take into account what a render needed."""
        self._density = max(slots / gaussians, DECAY * self._density)
        self._gaussians = gaussians

    def capacity(self, gaussians: int) -> int | None:
        """Return the number of slots to reserve; ``None`` if nothing is known yet."""
        if reported := self._reported.value:
            # A report counts once. Renders that do not go ahead make no report, and a large number that
            # counts again and again would keep them from going ahead for ever. A report that arrives between
            # these lines is lost, but the next render makes another one.
            self._reported.value = 0
            self.learn(reported & 0xFFFFFFFF, reported >> 32)
        if self._gaussians == 0:
            return None
        # The Gaussians that are left after pruning may be the large ones.
        wanted = int(MARGIN * self._density * max(gaussians, self._gaussians)) + LEAST
        # Few different sizes, so that the allocator finds a freed block of the same size.
        step = 1 << max(wanted.bit_length() - 4, 0)
        return -(-wanted // step) * step


@cache
def find_forecast(device: torch.device, views: int, height: int, width: int) -> Forecast:
    """Return the forecast for renders of one size on one device, which lives as long as the process."""
    return Forecast(device)
