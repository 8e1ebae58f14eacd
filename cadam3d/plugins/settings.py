"""CAdamSettings: the settings of ``densifier=cadam``, for code that does not read our YAML files."""

from dataclasses import dataclass, fields

from cadam3d.core.errors import UserError
from cadam3d.densifier.cadam import CAdam


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
