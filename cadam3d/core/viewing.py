"""Range checks of the settings that every picture of a finished asset shares."""

from cadam3d.core.checks import are_numbers, require, require_color, require_range, require_whole


def require_viewing(
    key: str, *, distance: object, fov_y_deg: object, size: object, background: object
) -> None:
    """Raise ``UserError`` unless a square picture can be taken so; ``key`` is the configuration node."""
    require_range(f"{key}.distance", distance, above=0, example=3.0)
    require_range(f"{key}.fov_y_deg", fov_y_deg, above=0, below=180, example=40)
    require_whole(f"{key}.size", size, low=1, example=256)
    require_color(f"{key}.background", background)


def require_elevations(key: str, elevations_deg: object) -> None:
    """Raise ``UserError`` unless there is at least one angle, all in [-90, 90] degrees."""
    require(
        are_numbers(elevations_deg, low=-90, high=90) and len(elevations_deg) > 0,
        f"{key}.elevations_deg",
        expected="at least one angle, each in [-90, 90]",
        got=elevations_deg,
        example=f"'{key}.elevations_deg=[15]'",
    )
