"""cadam3d: a sentence in, 3D Gaussians out, densified where the gradient drifts consistently (CAdam).

``train``, ``sweep``, ``evaluate``, ``load`` and ``compose`` are the Python API, which ``docs/python.md``
describes. Each name is loaded when it is first used, so that ``import cadam3d`` takes milliseconds.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

__version__ = "0.1.0"

# The module of each public name. ``__init__.pyi`` has the same names for type checkers.
_HOMES = {
    "Asset": "cadam3d.api.asset",
    "Callback": "cadam3d.callback.base",
    "ResultTable": "cadam3d.api.result_tables",
    "Run": "cadam3d.api.training",
    "Stepper": "cadam3d.api.stepping",
    "UserError": "cadam3d.core.errors",
    "compose": "cadam3d.api.stepping",
    "evaluate": "cadam3d.api.result_tables",
    "load": "cadam3d.api.asset",
    "sweep": "cadam3d.api.result_tables",
    "train": "cadam3d.api.training",
}

# What ``from cadam3d import *`` imports.
__all__ = list(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


class _Package(ModuleType):
    """This package, in which ``sweep`` is the function even after a module of ``cadam3d.sweep`` is loaded."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in _HOMES or not isinstance(value, ModuleType):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'cadam3d' has no attribute {name!r}")
    # Before anything else of the API loads torch.
    if _HOMES[name].startswith("cadam3d.api"):
        import_module("cadam3d.api")
    globals()[name] = value = getattr(import_module(_HOMES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*_HOMES, *(name for name in globals() if name.startswith("__"))})
