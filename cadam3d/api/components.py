"""Objects of the caller in place of the components that the settings name."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, TypedDict

from omegaconf import DictConfig, OmegaConf, open_dict

from cadam3d.augmentation import Augmentation
from cadam3d.background import Background
from cadam3d.camera.base import CameraSampler
from cadam3d.core.checks import fail
from cadam3d.densifier.base import Densifier
from cadam3d.densifier.refine import Refine
from cadam3d.exposure import Exposure
from cadam3d.guidance.base import Guidance
from cadam3d.initializer.base import Initializer
from cadam3d.optimizer import AdamSettings
from cadam3d.prior.base import DiffusionPrior
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.settings.compose import Call, escaped
from cadam3d.settings.line import key_of
from cadam3d.settings.options import TARGET


class Components(TypedDict, total=False):
    """The components that may be objects; None stands for the one that the settings name."""

    augmentation: Augmentation | None
    background: Background | None
    camera: CameraSampler | None
    densifier: Densifier | None
    exposure: Exposure | None
    guidance: Guidance | None
    initializer: Initializer | None
    optimizer: AdamSettings | None
    prior: DiffusionPrior | None
    rasterizer: Rasterizer | None
    refine: Refine | None


def given_objects(components: Components, overrides: Sequence[str]) -> dict[str, Any]:
    """Return the objects by the names of their groups.

    Raises ``TypeError`` for a name that is no component, and ``UserError`` for an object whose settings are
    among the ``overrides`` as well.
    """
    given = {name: value for name, value in components.items() if value is not None}
    if unknown := given.keys() - Components.__annotations__.keys():
        known = ", ".join(Components.__annotations__)
        raise TypeError(f"unexpected argument {min(unknown)!r}, expected one of {known}")
    for word in overrides:
        if (key := key_of(word)).partition(".")[0] in given:
            raise fail(
                key, expected="the object or its settings, not both", got=word, example="the object alone"
            )
    return given


def record_objects(cfg: DictConfig, call: Call, given: Mapping[str, Any]) -> None:
    """Describe objects in the settings of a run, in place of the components that they replace."""
    if not given:
        return
    # Other settings may refer to those that are replaced.
    OmegaConf.resolve(cfg)
    with open_dict(cfg), open_dict(call.hydra):
        for name, value in given.items():
            cfg[name] = described(value)
            call.hydra.runtime.choices[name] = type(value).__name__


def described(value: Any) -> Any:
    """Return plain data that describe an object, as far as possible like the YAML of a component."""
    if isinstance(value, Mapping):
        return {str(key): described(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [described(item) for item in value]
    if value is None or isinstance(value, bool | int | float | str):
        return escaped(value)
    cls = type(value)
    own = fields(value) if is_dataclass(value) else ()
    known = {each.name: described(getattr(value, each.name)) for each in own if each.init}
    return {TARGET: f"{cls.__module__}.{cls.__qualname__}", **known}
