"""Build: make the components that a configuration names. Nothing else in the package instantiates."""

import re
from collections.abc import Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any

import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException, UnsupportedValueType

from cadam3d.augmentation import Augmentation
from cadam3d.background import Background
from cadam3d.callback.base import Callback
from cadam3d.camera.base import CameraSampler
from cadam3d.core.checks import fail, require, require_choice
from cadam3d.core.errors import UserError
from cadam3d.densifier.base import Densifier
from cadam3d.densifier.refine import Refine
from cadam3d.exposure import Exposure
from cadam3d.guidance.base import Guidance
from cadam3d.optimizer import AdamSettings
from cadam3d.prior.base import DiffusionPrior
from cadam3d.rasterizer.base import Rasterizer
from cadam3d.regularizer import Regularizer
from cadam3d.settings.check import require_declared
from cadam3d.settings.compose import escaped
from cadam3d.settings.options import TARGET, option_names, read_option, with_example
from cadam3d.trainer import Trainer

CONFIGURATION = "configuration"  # the place of a node that has no other name
REFERENCE = re.compile(r"\$\{([\w.]+)\}")


def build_trainer(
    cfg: DictConfig,
    device: torch.device,
    given: Mapping[str, Any] = MappingProxyType({}),
    callbacks: Sequence[Callback] = (),
) -> Trainer:
    """Build the components that ``cfg`` names, and move the prior to ``device``.

    The objects in ``given``, by the name of their group, replace components of ``cfg``, which are then not
    built. ``callbacks`` are called after ``cfg``'s own. Raises ``UserError`` for wrong settings.
    """
    part = partial(chosen, cfg, given)
    refine: Refine = part("refine", Refine)
    require(
        refine.steps == cfg.steps,
        "refine.steps",
        expected=f"the length of the run, steps={cfg.steps}",
        got=refine.steps,
        example="refine.steps='${steps}'",
    )
    return Trainer(
        steps=cfg.steps,
        views=cfg.views,
        camera=part("camera", CameraSampler),
        background=part("background", Background),
        augmentation=part("augmentation", Augmentation),
        rasterizer=part("rasterizer", Rasterizer),
        prior=part("prior", DiffusionPrior).to(device),
        guidance=part("guidance", Guidance),
        densifier=part("densifier", Densifier),
        refine=refine,
        optimizer=part("optimizer", AdamSettings),
        exposure=part("exposure", Exposure),
        regularizers=components(cfg.regularizer, Regularizer, "regularizer"),
        callbacks=[*components(cfg.callback, Callback, "callback").values(), *callbacks],
    )


def chosen(cfg: DictConfig, given: Mapping[str, Any], name: str, kind: type) -> Any:
    """Return the object of a group in ``given``, or else build the component that ``cfg`` names.

    Raises ``UserError`` for an object that is not of the class ``kind``.
    """
    if name not in given:
        return component(cfg[name], kind, name)
    is_right = isinstance(given[name], kind)
    require(is_right, name, expected=f"an object of class {kind.__name__}", got=given[name])
    return given[name]


def component(node: Any, kind: type = object, key: str = CONFIGURATION) -> Any:
    """Build the object that ``node._target_`` names, and nested ones; lists and dicts become plain Python.

    ``kind`` is the class of the object and ``key`` is the place of the node, such as ``camera``. Raises
    ``UserError`` for mistakes in the configuration: values of a wrong type or out of range, unknown keys,
    missing keys, a target that cannot be imported or is of another kind. Nothing is built if a type is wrong.
    A bug in a constructor raises its own exception.
    """
    try:
        require_declared(node, (kind,), key)
        # Hydra resolves a component twice. A prompt such as ${oc.env:HOME}, which is plain text after the
        # first time, would be replaced the second time, so the content is escaped twice.
        return instantiate(_node_at(key, escaped(_content(node, key))), _convert_="all")
    except InstantiationException as error:
        raise _construction_error(error, node, key) from error
    except OmegaConfBaseException as error:
        raise _unreadable(error, key) from error


def components(group: Any, kind: type = object, key: str = CONFIGURATION) -> dict[str, Any]:
    """Build every chosen member of a group of which several can be chosen, by name.

    An experiment may tune a member that the line has not chosen; such a node has keys but no ``_target_``.
    """
    if not isinstance(group, DictConfig):
        raise fail(key, expected="a list of options", got=group, example=f"'{key}=[]'")
    return {
        str(name): component(node, kind, f"{key}.{name}")
        for name, node in group.items()
        if not isinstance(node, DictConfig) or TARGET in node
    }


def option(group: str, name: str, kind: type, changes: Mapping[str, Any] = MappingProxyType({})) -> Any:
    """Build one option of a group from its YAML file in this package, without a command line.

    ``changes`` replace values of the file. Raises ``UserError`` for an unknown option and for the mistakes
    that :func:`component` reports.
    """
    require_choice(group, name, option_names(group))
    values = read_option(group, name)[group]
    # A group of which several options can be chosen has each of them under its name.
    key = f"{group}.{name}" if name in values else group
    try:
        node = _node_at(key, values.get(name, values) | escaped(dict(changes)))
    except UnsupportedValueType as error:
        expected = "a number, a text or a list of them"
        raise fail(
            error.full_key or group, expected=expected, got=dict(changes), example=f"{group}={name}"
        ) from None
    return component(node, kind, key)


def _node_at(key: str, content: Any) -> Any:
    """Return plain data as a node of a configuration, in which its place is ``key``."""
    root = OmegaConf.create()
    OmegaConf.update(root, key, content, force_add=True)
    return OmegaConf.select(root, key)


def _content(node: Any, key: str) -> Any:
    """Return a node as plain data in which every text is literal, even if it looks like an interpolation."""
    try:
        return escaped(OmegaConf.to_container(node, resolve=True))
    except OmegaConfBaseException as error:
        raise _unreadable(error, key) from error


def _unreadable(error: OmegaConfBaseException, key: str) -> UserError:
    reason = str(error.msg).splitlines()[0]
    return UserError(f"{error.full_key or key}: {reason}. Try: cadam3d train --cfg job")


def _construction_error(error: InstantiationException, node: DictConfig, key: str) -> BaseException:
    """Return ``UserError`` for a mistake in the configuration, or else the exception of the constructor."""
    cause = error.__cause__
    named = re.search(r"full_key: (\S+)", str(error))
    where = _typed_place(node, key, named.group(1)) if named else key
    if isinstance(cause, UserError):
        return with_example(_placed(cause, where))
    if cause is None:
        return UserError(f"{where}: {str(error).splitlines()[0]}. Try: cadam3d train --cfg job")
    return cause


def _typed_place(node: DictConfig, key: str, where: str) -> str:
    """Return the place at which the user types a setting of the node ``where``, which is in ``node``.

    It is another place if the inner node is an interpolation: ``protocol`` for ``metric.niqe.protocol``.
    """
    raw: Any = OmegaConf.to_container(node, resolve=False)
    taken = REFERENCE.fullmatch(str(raw.get(where.removeprefix(f"{key}."))))
    return taken.group(1) if taken else where


def _placed(error: UserError, where: str) -> UserError:
    """Return the error of a constructor with the place of its node, which the constructor cannot know.

    A schedule, for example, writes ``Linear.steps``, which is ``optimizer.means_lr.steps`` here.
    """
    text = str(error)
    if not (named := re.match(r"([A-Z]\w*|[\w.]+)\.[\w.]+: ", text)) or f"{named.group(1)}.".startswith(
        f"{where}."
    ):
        return error
    inside, place = f"{named.group(1)}.", f"{where}."
    return UserError(text.replace(inside, place), key=error.key.replace(inside, place))
