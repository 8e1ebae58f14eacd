"""Stored arrays: the same bits, computed once, and no errors if nothing can be stored."""

import pytest
import torch

from cadam3d.prior.shapes.tracing import stored_arrays


class Measured:
    """Arrays that take long: a new random number for each call."""

    calls = 0

    def __call__(self) -> dict[str, torch.Tensor]:
        self.calls += 1
        return {"alpha": torch.rand(3, dtype=torch.float64)}


@pytest.fixture
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "cadam3d" / "shapes"


def test_the_second_process_reads_the_bits_of_the_first(cache, monkeypatch) -> None:
    measured = Measured()
    first, second = (stored_arrays("census-4", measured)["alpha"] for _ in range(2))
    assert torch.equal(first, second)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 77)
    stored_arrays("census-4", measured)
    assert measured.calls == len(list(cache.iterdir())) == 2


@pytest.mark.parametrize("trouble", ["a damaged file", "a file in place of the folder"])
def test_arrays_are_made_again_if_they_cannot_be_read(trouble, cache) -> None:
    measured = Measured()
    stored_arrays("census-4", measured)
    [file] = cache.iterdir()
    if trouble == "a damaged file":
        file.write_bytes(file.read_bytes()[:-9])
    else:
        file.unlink()
        cache.rmdir()
        cache.write_text("")
    stored_arrays("census-4", measured)
    assert measured.calls == 2
