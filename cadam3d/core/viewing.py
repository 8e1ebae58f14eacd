"""Range checks of the settings that every picture of a finished asset shares."""

from collections.abc import Sequence

from cadam3d.core.checks import require, require_range


def require_viewing(
    key: str, *, distance: float, fov_y_deg: float, size: int, background: Sequence[float]
) -> None:
    """Raise ``UserError`` unless a square picture can be taken so; ``key`` is the configuration node."""
    require_range(f"{key}.distance", distance, above=0, example=3.0)
    require_range(f"{key}.fov_y_deg", fov_y_deg, above=0, below=180, example=40)
    require_range(f"{key}.size", size, low=1, example=256)
    is_rgb = len(background) == 3 and all(0 <= channel <= 1 for channel in background)
    require(
        is_rgb,
        f"{key}.background",
        wanted="three numbers in [0, 1]",
        got=list(background),
        example=f"{key}.background=[1,1,1]",
    )


def require_elevations(key: str, elevations_deg: Sequence[float]) -> None:
    """Raise ``UserError`` unless there is at least one angle, all in [-90, 90] degrees."""
    require(
        len(elevations_deg) > 0 and all(-90 <= angle <= 90 for angle in elevations_deg),
        f"{key}.elevations_deg",
        wanted="at least one angle, each in [-90, 90]",
        got=list(elevations_deg),
        example=f"{key}.elevations_deg=[15]",
    )
