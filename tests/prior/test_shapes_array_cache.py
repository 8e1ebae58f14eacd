"""Arrays in the user's cache have the same bits, and a damaged or unwritable cache is not an error."""

from dataclasses import fields

import pytest
import torch

from cadam3d.prior.shapes import array_cache, prior


@pytest.fixture
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "cadam3d" / "shapes"


def census() -> prior.Census:
    return prior.take_census.__wrapped__(4, "auto")


def equal(one, other) -> bool:
    return all(torch.equal(getattr(one, field.name), getattr(other, field.name)) for field in fields(one))


def test_the_second_process_reads_the_bits_of_the_first(cache, monkeypatch):
    made = census()
    [path] = cache.iterdir()
    monkeypatch.setattr(prior, "_measure", lambda size, tracer: pytest.fail("the arrays were in the cache"))
    assert equal(census(), made)
    assert path.name.startswith("census-4-")


def test_other_sources_or_threads_make_another_file(cache, monkeypatch):
    census()
    monkeypatch.setattr(torch, "get_num_threads", lambda: 77)
    census()
    assert len(list(cache.iterdir())) == 2


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"nonsense"])
def test_a_damaged_file_is_made_again(content, cache):
    made = census()
    [path] = cache.iterdir()
    path.write_bytes(content)
    assert equal(census(), made)
    assert path.stat().st_size > len(content)


def test_arrays_are_computed_if_the_cache_cannot_be_written(monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    assert equal(census(), prior._measure(4, "auto"))
    assert array_cache.default_cache_dir().parts[1] == "dev"
