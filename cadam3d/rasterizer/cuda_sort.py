"""Prefix sums and a stable radix sort of unsigned 32-bit numbers, with the kernels of ``kernels/sort.cuh``.

Arrays are passed as addresses. Temporary memory belongs to the caller: ``scan_bytes`` and ``sort_bytes``
return how much of it is needed, one number for each array.
"""

from collections.abc import Sequence

from cadam3d.rasterizer.launcher import Launch

# The kernels define the same constants (kernels/device.cuh, kernels/sort.cuh).
BLOCK = 256  # threads
SCAN_CHUNK, SORT_CHUNK, RADIX_BITS = 2048, 4096, 8
# One block scans up to this many numbers alone, which is faster than three launches.
SCAN_SHORT = 8 * SCAN_CHUNK


def scan_bytes(count: int) -> int:
    """Return the bytes of the temporary array that :func:`scan` needs for ``count`` numbers."""
    return 0 if count <= SCAN_SHORT else 4 * _pieces(count, SCAN_CHUNK)


def scan(
    launch: Launch, values: int, sums: int, count: int, temporary: int, index: int = 0, total: int = 0
) -> None:
    """Write exclusive prefix sums of ``values``, or of ``values[index]``, to ``sums``.

    They saturate at the largest number. So does ``total``, if its address is given. Without an index,
    ``sums`` may be ``values``.
    """
    if count <= SCAN_SHORT:
        launch("scan_short", 1, BLOCK, values, index, count, sums, total)
        return
    chunks = _pieces(count, SCAN_CHUNK)
    launch("scan_reduce", chunks, BLOCK, values, index, count, temporary)
    launch("scan_short", 1, BLOCK, temporary, 0, chunks, temporary, total)
    launch("scan_apply", chunks, BLOCK, values, index, count, temporary, sums)


def sort_bytes(capacity: int, bits: int) -> tuple[int, ...]:
    """Return the bytes of the temporary arrays that :func:`sort` needs for ``capacity`` keys."""
    counts = _counts(capacity)
    pairs = 4 * capacity if bits > RADIX_BITS else 0
    return (4 * capacity, pairs, 4 * counts, scan_bytes(counts))


def sort(
    launch: Launch,
    keys: int,
    order: int,
    capacity: int,
    bits: int,
    temporary: Sequence[int],
    total: int = 0,
) -> int:
    """Sort unsigned keys by their lowest ``bits`` bits, and return the address of the sorted keys.

    Their old positions go to ``order``; equal keys keep their order. ``keys`` is overwritten. ``total`` is
    the address of the number of keys, which is 0 for all kernels if it exceeds ``capacity``. Without it,
    there are ``capacity`` keys.
    """
    other_keys, other_order, counts, sums_of_chunks = temporary
    if capacity == 0:
        return keys
    chunks, passes, old = _pieces(capacity, SORT_CHUNK), _pieces(bits, RADIX_BITS), 0
    for number in range(passes):
        shift = number * RADIX_BITS
        launch("sort_count", chunks, BLOCK, keys, total, capacity, shift, chunks, counts)
        scan(launch, counts, counts, _counts(capacity), sums_of_chunks)
        # The last pass writes to ``order``.
        new = order if (passes - number) % 2 else other_order
        inputs = (keys, old, total, capacity, shift, chunks, counts)
        launch("sort_scatter", chunks, BLOCK, *inputs, other_keys, new)
        keys, other_keys, old = other_keys, keys, new
    return keys


def _counts(capacity: int) -> int:
    """Return how many numbers a pass of the sort counts: one per digit and chunk."""
    return 2**RADIX_BITS * _pieces(capacity, SORT_CHUNK)


def _pieces(count: int, size: int) -> int:
    return -(-count // size)
