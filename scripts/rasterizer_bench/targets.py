"""Targets of the CUDA rasterizer, set before the first measurement: times, and a ratio to gsplat."""

# The largest accepted time of forward + backward in ms, for 4 views and degree 0. The keys are a part of the
# device's name, and then the number of Gaussians and the size in pixels.
MOST_MS = {
    "H200": {
        (100_000, 512): 2.0,
        (100_000, 1024): 4.0,
        (500_000, 512): 5.0,
        (500_000, 1024): 7.5,
        (1_000_000, 512): 8.0,
        (1_000_000, 1024): 11.0,
        (3_400_000, 512): 18.0,
        (3_400_000, 1024): 26.0,
    },
    "RTX 3090": {
        (100_000, 512): 3.5,
        (100_000, 1024): 7.0,
        (500_000, 512): 10.0,
        (500_000, 1024): 15.0,
        (1_000_000, 512): 16.0,
        (1_000_000, 1024): 22.0,
        (3_400_000, 512): 40.0,
        (3_400_000, 1024): 55.0,
    },
}
# The same for one view, at most SMALL Gaussians and at most SMALL_SIZE pixels, where overhead dominates.
MOST_MS_SMALL = 0.5
SMALL, SMALL_SIZE = 20_000, 512
# gsplat's time divided by ours, for 4 views and at least MANY Gaussians.
LEAST_RATIO = 1.8
MANY = 100_000


def demanded_ms(device: str, count: int, size: int, views: int, degree: int) -> float | None:
    """Return the largest accepted time of forward + backward in ms; ``None`` without a target."""
    known = [table for name, table in MOST_MS.items() if name in device]
    if not known or degree != 0:
        return None
    if views == 1 and count <= SMALL and size <= SMALL_SIZE:
        return MOST_MS_SMALL
    return known[0].get((count, size)) if views == 4 else None


def demanded_ratio(count: int, views: int) -> float | None:
    """Return the smallest accepted ratio of gsplat's time to ours; ``None`` without a target."""
    return LEAST_RATIO if count >= MANY and views == 4 else None
