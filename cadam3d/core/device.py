"""Device: from the name that a user types to a device that works on this machine."""

import torch

from cadam3d.core.checks import fail


def resolve_device(name: str) -> torch.device:
    """Return the device ``name``: ``auto`` is CUDA if available, else the CPU; other names are torch's.

    Raises ``UserError`` for a name that torch does not know, or a device that this machine does not have.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        # Reading a value back also refuses "meta", a device without memory.
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).strip().splitlines()[0]
        expected = f"a device of this machine ({reason})"
        raise fail("device", expected=expected, got=name, example="device=cpu") from error
    return device
