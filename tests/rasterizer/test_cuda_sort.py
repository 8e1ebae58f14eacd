"""Prefix sums and the sort of the CUDA rasterizer, on fibers, and on a GPU if there is one."""

import pytest
import torch
from emulation import as_signed, as_unsigned, check_sort, scan_tensor, sort_tensor

from cadam3d.rasterizer import cuda, cuda_sort
from cadam3d.rasterizer.build import KERNELS

pytestmark = pytest.mark.usefixtures("garbage_in_new_memory")

CPU = torch.device("cpu")


@pytest.mark.parametrize("n", [0, 1, 255, 2047, 2048, 2049, 16384, 16385, 20000])
def test_prefix_sums_are_exact_up_to_32_bits(emulator, n):
    values = torch.randint(0, 2**32 // max(n, 1), (n,), generator=torch.Generator().manual_seed(n))
    index = torch.randperm(n, generator=torch.Generator().manual_seed(n + 1))
    with emulator.on(CPU) as launch:
        plain, picked = (scan_tensor(launch, as_signed(values), each) for each in (None, index.int()))
    for sums, wanted in ((plain, values), (picked, values[index])):
        assert torch.equal(as_unsigned(sums[1:]), wanted.cumsum(0))
        assert sums[0] == 0


@pytest.mark.parametrize("n", [2, 300, 20000])
def test_prefix_sums_saturate(emulator, n):
    values = torch.zeros(n, dtype=torch.int64)
    # The total is above 2**32, so it would wrap around.
    values[: n // 2] = 2**32 // (n // 2) - 1
    values[-1] = 2**31
    with emulator.on(CPU) as launch:
        sums = as_unsigned(scan_tensor(launch, as_signed(values)))
    assert torch.equal(sums[1:], values.cumsum(0).clamp_max(2**32 - 1))


@pytest.mark.parametrize("n", [0, 1, 2, 31, 32, 33, 255, 256, 257, 4095, 4096, 4097, 5000, 12289])
def test_the_sort_is_exact_and_stable(emulator, n):
    for distinct, bit_count in ((1, 32), (7, 32), (10**6, 32), (10**6, 17), (2, 1)):
        check_sort(emulator, n, distinct, bit_count)


def test_the_sort_is_exact_when_its_counts_need_three_kernels(emulator):
    assert 270_000 // cuda_sort.SORT_CHUNK * 2**cuda_sort.RADIX_BITS > cuda_sort.SCAN_SHORT
    check_sort(emulator, 270_000, 10**6, 16)


@pytest.mark.parametrize("total", [0, 1, 4096, 4999, 5000])
def test_the_sort_touches_only_as_many_keys_as_the_device_has_counted(emulator, total):
    keys = torch.randint(0, 2**16, (5000,), generator=torch.Generator().manual_seed(0))
    with emulator.on(CPU) as launch:
        got, order = sort_tensor(launch, keys.int(), 16, total)
    want, want_order = keys[:total].sort(stable=True)
    assert torch.equal(got[:total].long(), want)
    assert torch.equal(order[:total].long(), want_order)
    assert (order[total:] == torch.iinfo(torch.int32).max).all(), "nothing is written behind them"


def test_the_sort_does_nothing_if_there_are_more_keys_than_room(emulator):
    with emulator.on(CPU) as launch:
        _, order = sort_tensor(launch, torch.arange(5000, dtype=torch.int32), 16, 5001)
    assert (order == torch.iinfo(torch.int32).max).all()


@pytest.mark.gpu
def test_the_sort_handles_more_than_2_to_27_keys(tmp_path):
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    n = 2**27 + 1
    keys = torch.randint(0, 2**31 - 1, (n,), dtype=torch.int32, device="cuda")
    with cuda.load_kernels(str(tmp_path)).on(keys.device) as launch:
        got, order = sort_tensor(launch, keys, 32)
    want, want_order = keys.sort(stable=True)
    assert torch.equal(got, want)
    assert torch.equal(order.long(), want_order)


def test_constants_mirror_those_of_the_kernels():
    source = "".join((KERNELS / f"{name}.cuh").read_text() for name in ("device", "sort"))
    assert f"BLOCK = {cuda_sort.BLOCK};" in source
    assert f"RADIX_BITS = {cuda_sort.RADIX_BITS};" in source
    assert (cuda_sort.SCAN_CHUNK, cuda_sort.SORT_CHUNK) == (cuda_sort.BLOCK * 8, cuda_sort.BLOCK * 16)
    assert "SCAN_ITEMS = 8;" in source
    assert "SORT_ROUNDS = 16;" in source
