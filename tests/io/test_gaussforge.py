"""SOG, ksplat and SPZ version 4 through gaussforge: the same object, the expected layout, clear refusals."""

import signal
import sys
import time

import numpy as np
import pytest
import torch
from formats import (
    errors,
    gaussforge_reads,
    is_finite,
    matched,
    random_gaussians,
)

from cadam3d.core import checks
from cadam3d.core.errors import UserError
from cadam3d.core.gaussians import Gaussians
from cadam3d.io import gaussforge
from cadam3d.io.frames import world_to_file
from cadam3d.io.gaussforge import read_forged, write_ksplat, write_sog, write_spz4

pytest.importorskip("gaussforge")
WRITERS = {"sog": write_sog, "ksplat": write_ksplat, "spz": write_spz4}


@pytest.mark.parametrize(("degree", "kept"), [(1, 1), (2, 2), (3, 2)])
def test_ksplat_has_a_block_for_each_degree_and_in_it_one_for_each_channel(tmp_path, degree, kept):
    gaussians = random_gaussians(40, degree=degree)
    write_ksplat(tmp_path / "a.ksplat", gaussians, up="-y")
    # At the end of the file: 3 + 3 + 4 floats, 4 bytes and the coefficients of each Gaussian.
    coefficients = 3 * ((kept + 1) ** 2 - 1)
    content = (tmp_path / "a.ksplat").read_bytes()
    record = np.dtype([("means", "<f4", 3), ("other", "u1", 32), ("sh", "<f4", coefficients)])
    rows = np.frombuffer(content[-40 * record.itemsize :], dtype=record)
    local = world_to_file(gaussians, "-y")
    order = torch.cdist(local.means, torch.from_numpy(rows["means"].copy())).argmin(dim=1)
    bands = [local.sh[:, d**2 : (d + 1) ** 2].mT.flatten(1) for d in range(1, kept + 1)]
    assert np.array_equal(rows["sh"][order.numpy()], torch.cat(bands, dim=1).numpy())


@pytest.mark.parametrize("kind", WRITERS)
def test_the_length_of_quaternions_does_not_matter(tmp_path, kind):
    gaussians = random_gaussians(50)
    longer = Gaussians(**{**gaussians.tensors(), "quats": -7 * gaussians.quats})
    for name, each in (("a", gaussians), ("b", longer)):
        WRITERS[kind](tmp_path / name, each, up="+z")
        back = matched(gaussforge_reads((tmp_path / name).read_bytes(), kind), gaussians)
        assert errors(back, gaussians)["angle_deg"] < 1


@pytest.mark.parametrize("kind", WRITERS)
def test_one_extreme_gaussian_costs_the_others_no_precision(tmp_path, kind):
    gaussians = random_gaussians(100)
    gaussians.log_scales[0], gaussians.opacity_logits[0], gaussians.sh[0] = 3e38, -3e38, 3e38
    WRITERS[kind](tmp_path / "a", gaussians, up="+z")
    back = gaussforge_reads((tmp_path / "a").read_bytes(), kind)
    assert is_finite(back)
    others = slice(1, None)
    restored = errors(matched(back, gaussians).index(others), gaussians.index(others))
    assert restored["log_scales"] < 0.3
    assert restored["opacities"] < 0.005
    assert restored["sh0"] < 0.5


@pytest.mark.parametrize("kind", ["sog", "ksplat"])
def test_no_gaussians_are_one_message(tmp_path, kind):
    with pytest.raises(UserError, match=rf"expected a Gaussian, which {kind} requires"):
        WRITERS[kind](tmp_path / "a", random_gaussians(0), up="-y")
    assert not list(tmp_path.iterdir())


def test_a_position_beyond_spz_4_is_one_message(tmp_path):
    gaussians = random_gaussians(3)
    gaussians.means[1, 2] = -2048
    with pytest.raises(UserError, match=r"up to 2,047.*got 2048. Try: exporter.spz.version=3$"):
        write_spz4(tmp_path / "a.spz", gaussians, up="+y")


@pytest.mark.parametrize("kind", WRITERS)
def test_without_the_package_the_message_names_the_extra(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(checks, "find_spec", lambda _: None)
    hint = r"Try: pip install '\.\[formats\]'$"
    message = rf"exporter\.{kind}: needs gaussforge\. {hint}"
    with pytest.raises(UserError, match=message):
        WRITERS[kind](tmp_path / "a", random_gaussians(3), up="-y")


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="no timers")
def test_ctrl_c_ends_the_work_of_gaussforge_at_once(tmp_path, monkeypatch):
    mark = tmp_path / "mark"
    waiting = f"import time; time.sleep(5); open({str(mark)!r}, 'w')"
    monkeypatch.setattr(gaussforge, "PROGRAM", waiting)

    def press(number, frame):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, press)
    signal.setitimer(signal.ITIMER_REAL, 0.7)
    start = time.monotonic()
    try:
        with pytest.raises(KeyboardInterrupt):
            write_sog(tmp_path / "a.sog", random_gaussians(3), up="-y")
    finally:
        signal.signal(signal.SIGALRM, before)
    assert time.monotonic() - start < 4
    assert not list(tmp_path.iterdir())


def test_a_crash_of_gaussforge_is_one_message(tmp_path, monkeypatch):
    monkeypatch.setattr(gaussforge, "PROGRAM", "import os; os.abort()")
    (tmp_path / "a.sog").write_bytes(b"PK\3\4")
    with pytest.raises(UserError, match=r"a\.sog: gaussforge cannot read it \(it ended with -?\d+\)"):
        read_forged(tmp_path / "a.sog", "sog")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits are promised on Linux")
def test_the_memory_of_reading_is_limited(tmp_path, monkeypatch):
    write_sog(tmp_path / "a.sog", random_gaussians(30), up="-y")
    assert len(read_forged(tmp_path / "a.sog", "sog")) == 30
    monkeypatch.setattr(gaussforge, "SPARE_BYTES", 1 << 20)
    monkeypatch.setattr(gaussforge, "MOST_EXPANSION", 1)
    with pytest.raises(UserError, match=r"a\.sog: gaussforge cannot read it") as caught:
        read_forged(tmp_path / "a.sog", "sog")
    assert "\n" not in str(caught.value)
