"""Prefix sums and the sort of the CUDA rasterizer, on fibers, and on a GPU if there is one."""

from contextlib import contextmanager

import pytest
import torch
from emulation import Emulator, as_signed, as_unsigned, check_sort, passes, scan_tensor, sort_tensor
from mutants import NUMBERS, SORTING

from cadam3d.rasterizer import cuda, cuda_sort
from cadam3d.rasterizer.base import KERNELS

pytestmark = pytest.mark.usefixtures("garbage_in_new_memory")

CPU = torch.device("cpu")
UNTOUCHED = torch.iinfo(torch.int32).max
# The ways to divide the work, for arrays so short that the emulator can sort them.
LAYOUTS = {
    "every block looks at all keys": {},
    "every block adds all counts": {"FEW_NUMBERS": 0},
    "a kernel adds the counts": {"FEW_NUMBERS": 0, "FEW_COUNTS": 0},
    "several chunks per block": {"FEW_NUMBERS": 0, "FEW_COUNTS": 0, "MOST_BLOCKS": 2},
    "long chunks": {"FEW_NUMBERS": 0, "FEW_COUNTS": 0, "WANTED_BLOCKS": 1},
    "several long chunks per block": {
        "FEW_NUMBERS": 0,
        "FEW_COUNTS": 0,
        "WANTED_BLOCKS": 1,
        "MOST_BLOCKS": 1,
    },
}


@contextmanager
def layout(name: str):
    """Change the constants that decide how the work is divided."""
    with pytest.MonkeyPatch.context() as patch:
        for constant, value in LAYOUTS[name].items():
            patch.setattr(cuda_sort, constant, value)
        yield


def check_scan(emulator: Emulator, n: int) -> None:
    values = torch.randint(0, 2**32 // max(n, 1), (n,), generator=torch.Generator().manual_seed(n))
    index = torch.randperm(n, generator=torch.Generator().manual_seed(n + 1))
    with emulator.on(CPU) as launch:
        plain, picked = (scan_tensor(launch, as_signed(values), each) for each in (None, index.int()))
    for sums, wanted in ((plain, values), (picked, values[index])):
        assert torch.equal(as_unsigned(sums[1:]), wanted.cumsum(0))
        assert sums[:1].sum() == 0


# -------------------------------------------------------------------------- prefix sums


@pytest.mark.parametrize("name", LAYOUTS)
def test_prefix_sums_are_exact_up_to_32_bits(emulator, name):
    with layout(name):
        for n in (0, 1, 31, 33, 255, 2047, 2048, 2049, 6143, 12289):
            check_scan(emulator, n)


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("n", [2, 300, 9000])
def test_prefix_sums_saturate(emulator, name, n):
    values = torch.zeros(n, dtype=torch.int64)
    # The total is above 2**32, so it would wrap around.
    values[: n // 2] = 2**32 // (n // 2) - 1
    values[-1] = 2**31
    with layout(name), emulator.on(CPU) as launch:
        sums = as_unsigned(scan_tensor(launch, as_signed(values)))
    assert torch.equal(sums[1:], values.cumsum(0).clamp_max(2**32 - 1))


# -------------------------------------------------------------------------- sort


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_sort_is_exact_and_stable(emulator, name):
    with layout(name):
        for n in (0, 1, 2, 31, 33, 255, 257, 1023, 1024, 1025, 4095, 4097):
            check_sort(emulator, n, 10**6, 17)
        for distinct, bit_count in ((1, 31), (7, 32), (10**6, 32)):
            check_sort(emulator, 5000, distinct, bit_count)


@pytest.mark.parametrize("bit_count", range(1, 33))
def test_the_sort_compares_any_number_of_bits(emulator, bit_count):
    # A third of the numbers of bits for each way to add the counts.
    with layout(list(LAYOUTS)[bit_count % 3]):
        check_sort(emulator, 2500, 10**6, bit_count)


def test_bits_above_the_lowest_are_not_compared(emulator):
    keys = torch.randint(0, 2**31, (3000,), generator=torch.Generator().manual_seed(0))
    with emulator.on(CPU) as launch:
        got, order = sort_tensor(launch, keys.int(), 5)
    want = (keys % 32).sort(stable=True).indices
    assert torch.equal(order.long(), want)
    assert torch.equal(got.long(), keys[want]), "whole keys are moved"


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("total", [0, 1, 1024, 4999, 5000])
def test_the_sort_touches_only_as_many_keys_as_the_device_has_counted(emulator, name, total):
    keys = torch.randint(0, 2**16, (5000,), generator=torch.Generator().manual_seed(0))
    with layout(name), emulator.on(CPU) as launch:
        got, order = sort_tensor(launch, keys.int(), 16, total)
    want, want_order = keys[:total].sort(stable=True)
    assert torch.equal(got[:total].long(), want)
    assert torch.equal(order[:total].long(), want_order)
    assert (order[total:] == UNTOUCHED).all(), "nothing is written behind them"


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("total", [5001, 2**32 - 1])
def test_the_sort_does_nothing_if_there_are_more_keys_than_room(emulator, name, total):
    counted = as_signed(torch.tensor(total)).item()
    with layout(name), emulator.on(CPU) as launch:
        _, order = sort_tensor(launch, torch.arange(5000, dtype=torch.int32), 16, int(counted))
    assert (order == UNTOUCHED).all()


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_order_alone_is_the_same(emulator, name):
    keys = torch.randint(0, 2**31 - 1, (3000,), dtype=torch.int32)
    order, other = torch.empty_like(keys), keys.clone()
    with layout(name), emulator.on(CPU) as launch:
        temporary = [keys.new_empty(size, dtype=torch.uint8) for size in cuda_sort.sort_bytes(3000, 32)]
        at = [tensor.data_ptr() for tensor in temporary]
        cuda_sort.sort_order(launch, other.data_ptr(), order.data_ptr(), 3000, 32, at)
    assert torch.equal(order.long(), keys.sort(stable=True).indices)


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_sort_does_not_depend_on_the_schedule_of_threads(emulator, name):
    with layout(name):
        for seed in (0, 2, 77):
            check_sort(emulator.shuffled(seed), 3000, 40, 16)


# -------------------------------------------------------------------------- launches and memory


def launches(capacity: int, bits: int) -> list[tuple]:
    """Return the launches of a sort, with symbolic addresses, without running them."""
    launched = []
    cuda_sort.sort(lambda *each: launched.append(each), 0, 0, capacity, bits, (0, 0, 2**40))
    return launched


def test_memory_for_many_keys_is_enough_for_fewer():
    before = {}
    for capacity in sorted({round(1.05**power) + shift for power in range(440) for shift in (-1, 0, 1)}):
        for bits in (1, 8, 13, 17, 22, 32):
            sizes = cuda_sort.sort_bytes(capacity, bits)
            for name, blocks, _, *arguments in launches(capacity, bits):
                assert blocks <= cuda_sort.MOST_BLOCKS
                if name == "sort_scatter":
                    width, counts = arguments[6], arguments[7]
                    assert not counts or sizes[2] >= 4 * (blocks + 1) << width
            assert all(size >= less for size, less in zip(sizes, before.get(bits, (0, 0, 0)), strict=True))
            before[bits] = sizes
        assert cuda_sort.scan_bytes(capacity) >= cuda_sort.scan_bytes(capacity - 1)


@pytest.mark.gpu
def test_the_sort_handles_more_than_2_to_27_keys(tmp_path):
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    n = 2**27 + 1
    try:
        keys = torch.randint(0, 2**31 - 1, (n,), dtype=torch.int32, device="cuda")
        with cuda.load_kernels(str(tmp_path)).on(keys.device) as launch:
            got, order = sort_tensor(launch, keys, 32)
        want, want_order = keys.sort(stable=True)
    except torch.OutOfMemoryError as error:
        pytest.skip(f"not enough memory: {error}".splitlines()[0])
    assert torch.equal(got, want)
    assert torch.equal(order.long(), want_order)


def test_constants_mirror_those_of_the_kernels():
    source = "".join((KERNELS / f"{name}.cuh").read_text() for name in ("device", "sort"))
    for line in (
        f"WARP = {cuda_sort.WARP};",
        f"BLOCK = {cuda_sort.BLOCK};",
        f"COLUMN_BLOCK = {cuda_sort.COLUMN_BLOCK};",
        f"DIGIT_BITS = {cuda_sort.DIGIT_BITS};",
        f"SORT_ITEMS = {cuda_sort.SORT_ITEMS};",
        f"SCAN_ITEMS = {cuda_sort.SCAN_CHUNK // cuda_sort.BLOCK};",
        f"COLUMN_ROWS = {cuda_sort.MOST_BLOCKS // cuda_sort.WARP};",
    ):
        assert f"constexpr int {line}" in source
    assert cuda_sort.FEW_NUMBERS < 2**16, "each half of a counter has 16 bits"


# -------------------------------------------------------------------------- mutants


def judge(emulator: Emulator) -> None:
    """Check prefix sums and sorts in every layout; each mutant must fail."""
    for seed, name in enumerate(LAYOUTS, start=1):
        machine = emulator.shuffled(seed)
        with layout(name):
            check_sort(machine, 5000, 7, 9)
            check_sort(machine, 5000, 10**6, 11)
            test_the_sort_touches_only_as_many_keys_as_the_device_has_counted(machine, name, 1500)
            check_scan(machine, 5000)
            test_prefix_sums_saturate(machine, name, 300)


def test_kernels_without_a_mistake_pass(emulator, mutants):
    assert passes(emulator, judge)
    assert passes(mutants, judge)


@pytest.mark.parametrize("mutant", SORTING)
def test_a_mutant_is_caught(mutants, mutant):
    assert not passes(mutants, judge, NUMBERS[mutant])
