"""Device: turns the name that a user types into a device that works on this machine."""

import torch

from cadam3d.core.errors import UserError


def resolve_device(name: str) -> torch.device:
    """Return the device ``name``: ``auto`` is CUDA if available, else the CPU; other names are torch's.

    Raises ``UserError`` for a name that torch does not know, or a device that this machine does not have.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).strip().splitlines()[0]
        raise UserError(f"device={name}: not usable here ({reason}). Try: device=cpu") from error
    return device
