"""A device is refused before any work if this machine lacks it, or if it lacks float64."""

import pytest
import torch

from cadam3d.core.device import resolve_device
from cadam3d.core.errors import UserError

OF_APPLE = "Cannot convert a MPS Tensor to float64 dtype as the MPS framework doesn't support float64."


def test_the_gpu_of_a_mac_is_refused_by_name_because_it_has_no_float64(monkeypatch):
    zeros = torch.zeros

    def as_on_a_mac(*size, dtype=torch.float32, device="cpu"):
        if torch.device(device).type == "mps" and dtype == torch.float64:
            raise TypeError(OF_APPLE)
        return zeros(*size, dtype=dtype)

    monkeypatch.setattr(torch, "zeros", as_on_a_mac)
    with pytest.raises(UserError, match=r"^device: .* float64 .*MPS.*, got 'mps'\. Try: device=cpu$"):
        resolve_device("mps")
    assert resolve_device("auto").type in ("cpu", "cuda")


@pytest.mark.parametrize("name", ["mps", "meta", "toaster", "cuda:99"])
def test_a_device_that_this_machine_lacks_is_refused(name):
    with pytest.raises(UserError, match=rf"^device: expected .* got '{name}'\. Try: device=cpu$"):
        resolve_device(name)
