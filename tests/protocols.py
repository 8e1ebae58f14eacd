"""A small protocol for the tests of metrics that score pictures."""

from typing import Any

from cadam3d.metric.protocol import RingProtocol


def ring(**changes: Any) -> RingProtocol:
    """Return a ring of three views on white, of which the mean counts, with some other settings."""
    settings: dict[str, Any] = {
        "name": "small",
        "views": 3,
        "elevations_deg": [0.0],
        "distance": 3.0,
        "fov_y_deg": 40.0,
        "size": 32,
        "background": [1.0, 1.0, 1.0],
        "crop": "none",
        "text": "{}",
        "aggregation": "mean",
        "models": {},
    }
    return RingProtocol(**settings | changes)
