"""Memory: recognise the exceptions of allocations that failed."""

import torch

# torch's wording, whose CPU allocator raises a plain RuntimeError.
CPU_FAILURES = ("can't allocate memory", "not enough memory", "Storage size calculation overflowed")


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether memory ran out."""
    if isinstance(error, torch.OutOfMemoryError | MemoryError):
        return True
    return isinstance(error, RuntimeError) and any(text in str(error) for text in CPU_FAILURES)
