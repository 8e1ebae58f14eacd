"""Prefix sums and a stable radix sort of unsigned 32-bit numbers, with the kernels of ``kernels/sort.cuh``.

Arrays are passed as addresses. Temporary memory belongs to the caller: ``scan_bytes`` and ``sort_bytes``
return how much of it is needed, one number for each array. More numbers never need less memory.
"""

from collections.abc import Sequence

from cadam3d.rasterizer.driver import Launch

# The kernels define the same constants (kernels/device.cuh, kernels/sort.cuh).
BLOCK, COLUMN_BLOCK, WARP = 256, 1024, 32  # threads
SCAN_CHUNK = 2048  # numbers that a block adds at a time
DIGIT_BITS = 11  # at most
SORT_ITEMS = 16  # keys of one thread at a time, at most

# No more blocks divide the numbers of an array among them; a block may process several chunks.
MOST_BLOCKS = 512
# Fewer keys per thread use more of the device if there are not enough keys for this many blocks.
WANTED_BLOCKS, FEWEST_ITEMS = 128, 4
# If there are no more numbers, each block adds all of those before its own, or counts all keys, because that
# should take less time than the launch that it saves. The counters of such a block have 16 bits.
FEW_NUMBERS = 2**15
# The same for the counts of all blocks.
FEW_COUNTS = 2**15


def scan_bytes(count: int) -> int:
    """Return the bytes of the temporary array that :func:`scan` needs for ``count`` numbers."""
    return 0 if count <= FEW_NUMBERS else 4 * _scan_blocks(count)


def scan(
    launch: Launch, values: int, sums: int, count: int, temporary: int, index: int = 0, total: int = 0
) -> None:
    """Write exclusive prefix sums of ``values``, or of ``values[index]``, to ``sums``.

    They saturate at the largest number. So does ``total``, if its address is given. ``sums`` is another array
    than ``values``.
    """
    blocks = _scan_blocks(count)
    if count <= FEW_NUMBERS:
        launch("scan_apply", blocks, BLOCK, values, index, count, 0, sums, total)
        return
    launch("scan_reduce", blocks, BLOCK, values, index, count, sums, temporary)
    # The first kernel has brought the numbers into the order of the index.
    inputs = (sums if index else values, 0, count, temporary)
    launch("scan_apply", blocks, BLOCK, *inputs, sums, total)


def digit_bits(bits: int) -> list[int]:
    """Return the number of bits of each digit: as few digits as possible, and about equally many bits."""
    digits = pieces(bits, DIGIT_BITS)
    return [(bits + number) // digits for number in reversed(range(digits))]


def sort_bytes(capacity: int, bits: int) -> tuple[int, ...]:
    """Return the bytes of the temporary arrays that :func:`sort` needs for ``capacity`` keys."""
    if capacity == 0:
        return 0, 0, 0
    digits = digit_bits(bits)
    wanted = max(WANTED_BLOCKS, pieces(capacity, SORT_ITEMS * BLOCK))
    rows = min(pieces(capacity, FEWEST_ITEMS * BLOCK), wanted, MOST_BLOCKS)
    # One more row receives the totals.
    counts = 0 if capacity <= FEW_NUMBERS else 4 * (rows + 1) << max(digits)
    return 4 * capacity, 4 * capacity if len(digits) > 1 else 0, counts


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
    there are ``capacity`` keys. The capacity is less than 2^31.
    """
    return _sort(launch, (keys, order, *temporary), (total, capacity), digit_bits(bits), writes_keys=True)


def sort_order(
    launch: Launch, keys: int, order: int, capacity: int, bits: int, temporary: Sequence[int]
) -> None:
    """Write only the order of :func:`sort`, which saves writing the sorted keys."""
    _sort(launch, (keys, order, *temporary), (0, capacity), digit_bits(bits), writes_keys=False)


def _sort(
    launch: Launch,
    arrays: tuple[int, ...],
    counted: tuple[int, int],
    digits: Sequence[int],
    writes_keys: bool,
) -> int:
    keys, order, other_keys, other_order, counts = arrays
    _, capacity = counted
    if capacity == 0:
        return keys
    assert capacity < 2**31, "the kernels index with 32 bits"
    items = min(max(pieces(capacity, BLOCK * WANTED_BLOCKS), FEWEST_ITEMS), SORT_ITEMS)
    blocks = min(pieces(capacity, BLOCK * items), MOST_BLOCKS)
    rows = counts if capacity > FEW_NUMBERS else 0
    shift, old = 0, 0
    for number, width in enumerate(digits):
        rest = len(digits) - number
        totals = counts + 4 * (blocks << width) if rows and blocks << width > FEW_COUNTS else 0
        if rows:
            launch("sort_count", blocks, BLOCK, keys, *counted, items, shift, width, rows)
        if totals:
            columns = pieces(1 << width, WARP)
            launch("sort_columns", columns, COLUMN_BLOCK, *counted, items, width, blocks, rows, totals)
        # The last pass writes to ``order``.
        new = order if rest % 2 else other_order
        results = (other_keys if writes_keys or rest > 1 else 0, new)
        inputs = (keys, old, *counted, items, shift, width, rows, totals)
        launch("sort_scatter", blocks, BLOCK, *inputs, *results)
        keys, other_keys, old, shift = other_keys, keys, new, shift + width
    return keys


def _scan_blocks(count: int) -> int:
    return min(max(pieces(count, SCAN_CHUNK), 1), MOST_BLOCKS)


def pieces(count: int, size: int) -> int:
    """Return how many pieces of at most ``size`` make ``count``."""
    return -(-count // size)
