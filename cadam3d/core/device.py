"""Device: from the name that a user types to a device that works here."""

import torch

from cadam3d.core.errors import UserError


def resolve_device(name: str) -> torch.device:
    """``auto`` is CUDA where there is one, else the CPU; other names are torch's.

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
