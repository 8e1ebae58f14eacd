"""What every prior with known images has: a census that is taken once and kept."""

import pytest
import torch

from cadam3d.prior.exact import ExactScene, stored_census


class Ball(ExactScene):
    """A scene whose images are new random numbers for each call."""

    log_weights = torch.zeros(1)
    calls = 0

    def draw(self, cameras, background, samples):
        self.calls += 1
        size = (len(cameras), 1, cameras.height, cameras.width)
        return torch.rand(*size[:2], 3, *size[2:]), torch.rand(size)

    def surfaces(self):
        raise AssertionError("a census needs no surface")

    def census(self, size):
        return stored_census("ball", [self], size)


@pytest.fixture
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "cadam3d" / "census"


def test_the_second_process_reads_the_bits_of_the_first(cache, monkeypatch) -> None:
    ball = Ball()
    first, second = (ball.census(4).maps for _ in range(2))
    assert torch.equal(first, second)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 77)
    ball.census(4)
    assert ball.calls == len(list(cache.iterdir())) == 2


@pytest.mark.parametrize("trouble", ["a damaged file", "a file in place of the folder"])
def test_a_census_is_taken_again_if_it_cannot_be_read(trouble, cache) -> None:
    ball = Ball()
    ball.census(4)
    [file] = cache.iterdir()
    if trouble == "a damaged file":
        file.write_bytes(file.read_bytes()[:-9])
    else:
        file.unlink()
        cache.rmdir()
        cache.write_text("")
    ball.census(4)
    assert ball.calls == 2
