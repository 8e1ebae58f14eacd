"""How much memory a network will hold, before it exists: it is built and run without data, and counted.

Everything happens on torch's ``meta`` device: shapes only. What is counted is what the network's operations
make and keep alive, the activations; attention counts as the memory-efficient kernels that GPUs use.
"""

import weakref
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  (the name everybody knows)
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


def working_bytes(call: Callable[[], object], existing: Iterable[Tensor]) -> int:
    """The most bytes alive at once of what ``call`` makes on the meta device, beside ``existing`` tensors.

    Run under ``torch.no_grad()`` this is the scratch space of a network; with gradients it includes what the
    backward pass will need.
    """
    kept = [tensor.untyped_storage() for tensor in existing]
    counter = _Counter({storage._cdata for storage in kept})
    with torch.device("meta"), counter, _EfficientAttention():
        result = call()  # held, for the graph behind it is what is measured
    del result
    return counter.peak


class _Counter(TorchDispatchMode):
    """Adds up storages as operations make them, and subtracts them as they die."""

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
    """On the meta device attention falls back to whole score matrices, which no GPU kernel makes."""

    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = kwargs or {}
        if func is not F.scaled_dot_product_attention:
            return func(*args, **kwargs)
        names = ("query", "key", "value")
        query, _, value = (args[i] if i < len(args) else kwargs[name] for i, name in enumerate(names))
        return query * value.new_ones(*query.shape[:-1], value.shape[-1])  # as large, and keeps its inputs
