"""What the CUDA rasterizer has to reach, decided before it ran: milliseconds, and the ratio to gsplat."""

# Part of a device's name, Gaussians, pixels: at most so many ms of forward + backward, 4 views, degree 0.
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
MOST_MS_SMALL = 0.5  # up to SMALL Gaussians, one view, degree 0: here it is all overhead
SMALL, SMALL_SIZE = 20_000, 512
LEAST_RATIO = 1.8  # gsplat's time over ours, from MANY Gaussians on, 4 views
MANY = 100_000


def demanded_ms(device: str, count: int, size: int, views: int, degree: int) -> float | None:
    """At most so many milliseconds of forward + backward; ``None`` where nothing was decided."""
    known = [table for name, table in MOST_MS.items() if name in device]
    if not known or degree != 0:
        return None
    if views == 1 and count <= SMALL and size <= SMALL_SIZE:
        return MOST_MS_SMALL
    return known[0].get((count, size)) if views == 4 else None


def demanded_ratio(count: int, views: int) -> float | None:
    """At least so many times as fast as gsplat on the same machine; ``None`` where nothing was decided."""
    return LEAST_RATIO if count >= MANY and views == 4 else None
