"""CAdamTracker: the moments of ``densifier=cadam`` for any trainer that has a tensor of means."""

from collections.abc import Mapping
from dataclasses import InitVar, dataclass, field, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from cadam3d.core.checks import fail, require
from cadam3d.core.errors import UserError
from cadam3d.densifier.cadam import CAdam, CAdamState


@dataclass(kw_only=True)
class CAdamSettings:
    """The paper's settings, with the values of ``configs/densifier/cadam.yaml`` as defaults.

    A test keeps the two equal. Settings may change during training, because each call reads them again: for
    a schedule of ``tau_Q``, assign a new number at every step.
    """

    # A Gaussian grows only if its drift exceeds this quantile of all drifts, in [0, 1); None for no such
    # gate.
    tau_Q: float | None = 0.9
    # A Gaussian grows only if its signal-to-noise ratio exceeds this number, >= 0; None for no such gate.
    # Below it, a Gaussian is unreliable.
    tau_SNR: float | None = 0.1
    beta1: float = 0.9  # in [0, 1), decay of the first moment
    beta2: float = 0.999  # in [0, 1), decay of the second moment
    eps: float = 1e-15  # > 0, loss per world unit
    min_age: int = 20  # updates before a Gaussian may grow
    reset: str = "unreliable"  # which opacities a reset lowers: unreliable, all or none

    def _cadam(self, reset_min_age: int) -> CAdam:
        """Return the densifier with these settings. Raises :class:`UserError` for a wrong value."""
        chosen = {field.name: getattr(self, field.name) for field in fields(CAdamSettings)}
        try:
            return CAdam(**chosen, reset_min_age=reset_min_age)
        except UserError as error:
            # In Python a setting is a keyword argument, without the name of its group.
            raise UserError(str(error).replace("densifier.", "").replace("CAdam.", "")) from None


@dataclass(eq=False)
class CAdamTracker(CAdamSettings):
    """Running moments of the gradients of Gaussians, which say what to grow and which opacities to reset.

    ``CAdamTracker(means)`` starts with as many Gaussians as ``means`` has rows, all newborn, on its device.
    The trainer calls

    - :meth:`observe` after each backward pass, before the optimizer moves anything,
    - :meth:`select` to decide which Gaussians to clone or split, and :meth:`unreliable` to decide whose
      opacity to reset,
    - :meth:`append`, :meth:`keep` or :meth:`follow` whenever rows of its tensors are added or removed.

    The arithmetic is the same as in ``densifier=cadam``. The moments take 28 bytes per Gaussian.
    """

    means: InitVar[Float[Tensor, "n 3"]]  # read for its number of rows and its device only
    # Updates before a Gaussian may be called unreliable: one interval between refinements, the paper's K.
    reset_min_age: int = field(default=100, kw_only=True)
    state: CAdamState = field(init=False, repr=False)

    def __post_init__(self, means: Float[Tensor, "n 3"]) -> None:
        self.state = self.cadam().init_state(len(means), means.device)

    def __len__(self) -> int:
        return len(self.state.age)

    def cadam(self) -> CAdam:
        """Return the densifier with the current settings. Raises :class:`UserError` for a wrong value."""
        return self._cadam(self.reset_min_age)

    def observe(self, gradient: Tensor | None) -> None:
        """Update the moments with the gradient of the loss to the means, in loss per world unit.

        Call this once per step of the optimizer. The shape is (n, 3). The gradient may be sparse. If any of
        its numbers is NaN or infinite, the step changes nothing. This does not wait for the device. Raises
        :class:`UserError` if the tracker follows another number of Gaussians, or if there is no gradient.
        """
        if gradient is None or gradient.shape != (len(self), 3):
            got = None if gradient is None else tuple(gradient.shape)
            example = "tracker.append(count) or tracker.keep(mask)"
            raise fail("observe", expected=f"a gradient of shape ({len(self)}, 3)", got=got, example=example)
        self.state = self.cadam().update(self.state, dense(gradient))

    def select(self, most: int | None = None) -> Bool[Tensor, "n"]:
        """Return the mask of Gaussians to grow (paper eq. 9 and 11). The trainer chooses how they grow.

        With ``most``, those with the largest drifts grow, at most this many.
        """
        # The thresholds do not depend on the step.
        return select(self.cadam(), self.state, 0, most)

    def unreliable(self) -> Bool[Tensor, "n"]:
        """Return the mask of Gaussians whose opacity a reset lowers (paper eq. 13)."""
        return self.cadam().unreliable(self.state)

    def scores(self) -> dict[str, Float[Tensor, "n"]]:
        """Return drift and noise, in loss per world unit, and ``snr``, their ratio, for logs and pictures."""
        return self.cadam().scores(self.state)

    def append(self, count: int) -> None:
        """Add ``count`` newborn Gaussians after all others; newborns start at zero with age 0 (sec. 4.2)."""
        rows = torch.arange(len(self), device=self.state.age.device)
        self.follow(torch.cat([rows, rows.new_full((count,), -1)]))

    def keep(self, mask: Bool[Tensor, "n"]) -> None:
        """Remove all Gaussians that ``mask`` does not mark; the others keep their order and their history."""
        expected = f"a mask of {len(self)} Gaussians"
        require(mask.shape == (len(self),), "keep", expected=expected, got=tuple(mask.shape))
        self.follow(mask.nonzero()[:, 0])

    def follow(self, rows: Int[Tensor, "after"]) -> None:
        """Follow any other change: ``rows`` has the old row number of each Gaussian, or -1 for a newborn.

        With it, Gaussians can change their order, and a child can take the place of its parent.
        """
        rows = rows.to(self.state.age.device)
        is_in_range, expected = (rows >= -1) & (rows < len(self)), f"row numbers from -1 to {len(self) - 1}"
        require(bool(is_in_range.all()), "follow", expected=expected, got=rows.tolist())

        def carry(history: Tensor) -> Tensor:
            # Row -1 is the last one, which holds zeros.
            return torch.cat([history, history.new_zeros((1, *history.shape[1:]))])[rows]

        self.state = CAdamState(**{name: carry(history) for name, history in self.state.to_dict().items()})

    def to(self, device: torch.device | str) -> "CAdamTracker":
        """Move the moments to ``device`` and return this tracker."""
        self.state = CAdamState(
            **{name: history.to(device) for name, history in self.state.to_dict().items()}
        )
        return self

    def state_dict(self) -> dict[str, Tensor]:
        """Return the moments by name, for a checkpoint. The settings are not part of it."""
        return self.state.to_dict()

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Continue from what :meth:`state_dict` returned, on the device of this tracker.

        The tracker then has as many Gaussians as ``state``.
        """
        device = self.state.age.device
        self.state = CAdamState(**{name: rows.to(device, copy=True) for name, rows in state.items()})


def select(cadam: CAdam, state: CAdamState, step: int, most: int | None) -> Bool[Tensor, "n"]:
    """Return the mask of Gaussians to grow, at most ``most`` of them: those with the largest drifts."""
    # CAdam draws nothing from the generator.
    selected = cadam.select(state, step, torch.Generator())
    if most is None or int(selected.sum()) <= most:
        return selected
    drift = torch.where(selected, state.drift(cadam.beta1), -1.0)
    return torch.zeros_like(selected).index_fill(0, drift.topk(max(0, most)).indices, True)


def dense(gradient: Tensor) -> Float[Tensor, "n 3"]:
    """Return a gradient as float32, outside autograd; rows that a sparse gradient leaves out are zero."""
    return gradient.detach().to_dense().float()
