"""CAdamStrategy: CAdam as a densification strategy of gsplat, in place of its ``DefaultStrategy``.

The strategy observes what the optimizer of the means uses: a hook reads the gradient right before each step
of that optimizer. By then the gradients of several cameras and of several backward passes have been added
up, and the scale of a mixed-precision loss has been removed. A step that is skipped is not observed, and it
does not matter how early the trainer clears its gradients.

This is written for gsplat 1.5.3, and uses nothing that differs on gsplat's main branch.
"""

import warnings
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import duplicate, split
from jaxtyping import Float
from torch import Tensor
from torch.nn import Parameter, ParameterDict
from torch.optim import Optimizer

from cadam3d.core.checks import require, require_range, require_whole
from cadam3d.densifier.cadam import CAdam, CAdamState
from cadam3d.plugins.opacity import reset_opacities
from cadam3d.plugins.tracker import CAdamSettings, dense, select

# The rows of the state that CAdam keeps, as in CAdamState.
MOMENTS = ("m", "v", "age")
# Opacities are reset to this multiple of the opacity below which Gaussians are pruned, as in gsplat.
RESET_OVER_PRUNE = 2.0

Params = dict[str, Parameter] | ParameterDict
Optimizers = dict[str, Optimizer]


@dataclass
class CAdamStrategy(CAdamSettings, DefaultStrategy):
    """Grow the Gaussians whose gradient drifts consistently; clone, split and prune them as gsplat does.

    The settings of ``DefaultStrategy`` keep their names, defaults and meaning, except three: ``grow_grad2d``,
    ``absgrad`` and ``key_for_gradient`` are accepted but ignored, because the gates of CAdam replace the
    threshold on screen-space gradients. Lengths (``grow_scale3d``, ``prune_scale3d``) are in units of
    ``scene_scale``. Opacity resets lower the opacities of unreliable Gaussians only, and none that has no
    optimizer.

    The strategy is used like ``DefaultStrategy``, and also in loops for ``MCMCStrategy``, which pass ``lr``.
    It needs ``optimizers["means"]`` to be stepped once per training step. All tensors are in the state, which
    may be saved with ``torch.save`` at any time between two steps.
    """

    # Updates before a Gaussian may be called unreliable; None for refine_every.
    reset_min_age: int | None = field(default=None, kw_only=True)
    # CAdam grows no more than this many Gaussians, as in ``MCMCStrategy``. Its gates are relative, so that a
    # share of the Gaussians grows at every refinement, however many there are.
    cap_max: int = field(default=1_000_000, kw_only=True)

    def __post_init__(self) -> None:
        require_whole("refine_every", self.refine_every, low=1)
        require_whole("reset_every", self.reset_every, low=1)
        require_whole("cap_max", self.cap_max, low=1)
        require_range("prune_opa", self.prune_opa, low=0, below=1 / RESET_OVER_PRUNE)
        self.cadam()

    def cadam(self) -> CAdam:
        """Return the densifier with the current settings. Raises :class:`UserError` for a wrong value."""
        return self._cadam(self.refine_every if self.reset_min_age is None else self.reset_min_age)

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """Return the state before the first step. ``scene_scale`` is the unit of length, in world units.

        The tensors appear with the first gradient, on its device.
        """
        return {**dict.fromkeys(MOMENTS), "scene_scale": scene_scale, "radii": None}

    def step_pre_backward(
        self, params: Params, optimizers: Optimizers, state: dict[str, Any], step: int, info: dict[str, Any]
    ) -> None:
        """Prepare to observe the next step of the optimizer of the means."""
        self._attach(optimizers, state, step)

    def step_post_backward(
        self,
        params: Params,
        optimizers: Optimizers,
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        packed: bool = False,
        lr: float | None = None,
    ) -> None:
        """Grow and prune, and reset opacities, if the schedule says so at ``step``, which counts from 0.

        ``packed`` says whether the rasterization was packed. ``lr`` is not used; loops for ``MCMCStrategy``
        pass it. Changes ``params``, ``optimizers`` and ``state`` in place.
        """
        observer = self._attach(optimizers, state, step)
        if observer is None:
            return
        if step < self.refine_scale2d_stop_iter:
            self._measure(state, info, len(params["means"]), packed)
        refines = (
            step > self.refine_start_iter
            and step % self.refine_every == 0
            and step % self.reset_every >= self.pause_refine_after_reset
        )
        # Nothing would raise the opacities again if they are not trained.
        can_reset = self.reset != "none" and "opacities" in optimizers
        resets = can_reset and step > 0 and step % self.reset_every == 0
        if not (refines or resets) or not self._has_evidence(state, step - observer.since):
            return
        if refines:
            self._refine(params, optimizers, state, step)
        if resets:
            rows = self.cadam().unreliable(_moments(state))
            value = RESET_OVER_PRUNE * self.prune_opa
            lowered = reset_opacities(params["opacities"], rows, optimizers["opacities"], value)
            if self.verbose:
                print(f"Step {step}: reset the opacity of {lowered} of {len(rows)} Gaussians.")

    def _attach(self, optimizers: Optimizers, state: dict[str, Any], step: int) -> "_Observer | None":
        """Let the optimizer of the means report its gradients to ``state``, and return what does so.

        From ``refine_stop_iter`` on nothing is decided any more, so nothing is observed either, and the
        result is ``None``.
        """
        optimizer = optimizers["means"]
        observer = _OBSERVERS.get(optimizer)
        if step >= self.refine_stop_iter:
            if observer is not None:
                observer.detach(optimizer)
            return None
        if observer is None:
            observer = _Observer(optimizer, step)
            # Trainers count their steps from 0 or from 1.
            if step > 1 and state["age"] is None:
                text = f"CAdamStrategy starts at step {step} without its saved state, so others grow."
                warnings.warn(text, stacklevel=3)
        observer.strategy, observer.state = self, state
        observer.is_stepping = False
        # A state that was loaded from a file may be on another device.
        device = optimizer.param_groups[0]["params"][0].device
        state.update({name: each.to(device) for name, each in state.items() if isinstance(each, Tensor)})
        return observer

    def _observe(self, state: dict[str, Any], gradient: Float[Tensor, "n 3"]) -> None:
        """Update the moments in ``state`` with one gradient of the means."""
        cadam = self.cadam()
        is_new = state["age"] is None
        moments = cadam.init_state(len(gradient), gradient.device) if is_new else _moments(state)
        state.update(cadam.update(moments, gradient).to_dict())

    def _has_evidence(self, state: dict[str, Any], waited: int) -> bool:
        """Return whether any gradient was observed. Raises if none came for a whole refinement interval."""
        if state["age"] is not None:
            return True
        got = f"no step of optimizers['means'] in {waited} training steps"
        require(waited < self.refine_every, "optimizers", expected="those of the trainer", got=got)
        return False

    @torch.no_grad()
    def _refine(self, params: Params, optimizers: Optimizers, state: dict[str, Any], step: int) -> None:
        """Clone and split what CAdam selects, and prune, with gsplat's operations."""
        before = len(params["means"])
        selected = select(self.cadam(), _moments(state), step, self.cap_max - before)
        longest = params["scales"].exp().amax(dim=-1)
        is_large = longest > self.grow_scale3d * state["scene_scale"]
        is_cloned, is_split = selected & ~is_large, selected & is_large
        uses_radii = step < self.refine_scale2d_stop_iter
        if uses_radii:
            is_split |= state["radii"] > self.grow_scale2d
        cloned, splits = int(is_cloned.sum()), int(is_split.sum())
        if cloned:
            duplicate(params=params, optimizers=optimizers, state=state, mask=is_cloned)
            _start_newborns(state, cloned)
        if splits:
            mask = torch.cat([is_split, is_split.new_zeros(cloned)])
            rows = {"params": params, "optimizers": optimizers, "state": state, "mask": mask}
            split(**rows, revised_opacity=self.revised_opacity)
            _start_newborns(state, 2 * splits)
        pruned = self._prune_gs(params, optimizers, state, step)
        if uses_radii:
            state["radii"].zero_()
        # The replaced tensors are as large as the new ones.
        torch.cuda.empty_cache()
        if self.verbose:
            print(f"Step {step}: of {before} Gaussians {cloned} cloned, {splits} split, {pruned} pruned.")

    @torch.no_grad()
    def _measure(self, state: dict[str, Any], info: dict[str, Any], count: int, packed: bool) -> None:
        """Remember the largest radius on screen since the last refinement, as a share of the image."""
        radii = info["radii"].amax(dim=-1) / float(max(info["width"], info["height"]))
        if state["radii"] is None:
            state["radii"] = radii.new_zeros(count)
        if packed:
            state["radii"].scatter_reduce_(0, info["gaussian_ids"].long(), radii, "amax")
        else:
            torch.maximum(state["radii"], radii.flatten(0, -2).amax(dim=0), out=state["radii"])


class _Observer:
    """The hooks on one optimizer, and the state to which they add its gradients."""

    strategy: CAdamStrategy
    state: dict[str, Any]

    def __init__(self, optimizer: Optimizer, since: int) -> None:
        self.since = since  # first step
        # Whether the optimizer is in its step. If a subclass calls the step of its parent, hooks run twice.
        self.is_stepping = False
        self._handles = (
            optimizer.register_step_pre_hook(_before_step),
            optimizer.register_step_post_hook(_after_step),
        )
        _OBSERVERS[optimizer] = self

    def detach(self, optimizer: Optimizer) -> None:
        """Remove the hooks."""
        for handle in self._handles:
            handle.remove()
        del _OBSERVERS[optimizer]


# Kept outside of strategies and states, because gsplat's trainer writes the strategy into a file, and users
# save the state with torch.save.
_OBSERVERS: WeakKeyDictionary[Optimizer, _Observer] = WeakKeyDictionary()


@torch.no_grad()
def _before_step(optimizer: Optimizer, args: tuple, kwargs: dict[str, Any]) -> None:
    """Observe the gradient that the optimizer is going to use."""
    observer = _OBSERVERS[optimizer]
    gradient = optimizer.param_groups[0]["params"][0].grad
    if observer.is_stepping or gradient is None:
        return
    observer.is_stepping = True
    gradient = dense(gradient)
    # For fused optimizers, GradScaler leaves the division by the scale of the loss to the optimizer.
    scale = getattr(optimizer, "grad_scale", None)
    observer.strategy._observe(observer.state, gradient if scale is None else gradient / scale)


def _after_step(optimizer: Optimizer, args: tuple, kwargs: dict[str, Any]) -> None:
    """Be ready for the next step."""
    _OBSERVERS[optimizer].is_stepping = False


def _moments(state: dict[str, Any]) -> CAdamState:
    """Return the moments in ``state``."""
    return CAdamState(**{name: state[name] for name in MOMENTS})


def _start_newborns(state: dict[str, Any], count: int) -> None:
    """Give the last ``count`` rows, which gsplat copies from the parents, zero moments and age 0."""
    for name in MOMENTS:
        state[name][len(state[name]) - count :] = 0
