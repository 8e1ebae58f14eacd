"""Estimates of the memory of networks that are not loaded: a network runs without data, to count its tensors.

Everything happens on torch's ``meta`` device, which has shapes and no numbers. The estimates count the
tensors that the operations of the network create and keep alive, its activations. They assume the attention
of the memory-efficient kernels of GPUs.
"""

import weakref
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  (the usual name)
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


def working_bytes(call: Callable[[], object], existing: Iterable[Tensor]) -> int:
    """Return the peak number of bytes that ``call`` allocates on the meta device.

    The ``existing`` tensors are not counted. Under ``torch.no_grad()`` the result is the scratch memory of a
    network; with gradients it includes everything that the backward pass will need.
    """
    kept = [tensor.untyped_storage() for tensor in existing]
    counter = _Counter({storage._cdata for storage in kept})
    with torch.device("meta"), counter, _EfficientAttention():
        # The result keeps its graph alive, which is part of the measurement.
        result = call()
    del result
    return counter.peak


class _Counter(TorchDispatchMode):
    """Adds up storages when operations create them, and subtracts them when they are freed."""

    def __init__(self, ignored: set[int]) -> None:
        super().__init__()
        self.ignored, self.alive = ignored, dict[int, int]()
        self.now = self.peak = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        made = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(made):
            if isinstance(tensor, Tensor):
                storage = tensor.untyped_storage()
                if storage._cdata not in self.alive and storage._cdata not in self.ignored:
                    self.alive[storage._cdata] = storage.nbytes()
                    self.now += storage.nbytes()
                    self.peak = max(self.peak, self.now)
                    weakref.finalize(storage, self._forget, storage._cdata)
        return made

    def _forget(self, key: int) -> None:
        self.now -= self.alive.pop(key, 0)


class _EfficientAttention(TorchFunctionMode):
    """Replaces attention, which on the meta device allocates score matrices that no GPU kernel allocates."""

    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = kwargs or {}
        if func is not F.scaled_dot_product_attention:
            return func(*args, **kwargs)
        names = ("query", "key", "value")
        query, _, value = (args[i] if i < len(args) else kwargs[name] for i, name in enumerate(names))
        # A product of the same size as the output; its graph keeps the inputs alive.
        return query * value.new_ones(*query.shape[:-1], value.shape[-1])
