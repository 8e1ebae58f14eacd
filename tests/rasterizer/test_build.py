"""Building the native kernels. Most tests use a fake compiler, so they compile nothing."""

import multiprocessing
import os
import re
import shlex
import sys
from pathlib import Path

import pytest

from cadam3d.core.errors import UserError
from cadam3d.io.cache import default_cache_dir
from cadam3d.rasterizer import build as module
from cadam3d.rasterizer.build import (
    KERNELS,
    SOURCES,
    build,
    find_cached,
    find_compiler,
    find_intact,
    load,
    own_folder,
    short_hash,
)

pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="the fake compiler is a shell script"),
    pytest.mark.skipif(find_compiler() is None, reason="no C++ compiler"),
]


@pytest.fixture
def fake_compiler(tmp_path, monkeypatch, kernel_build):
    """Install a compiler that prints its version, records each call in ``calls`` and then runs ``body``."""

    def install(body="cp {library} $out", version="fake 1.0"):
        script, calls = tmp_path / "compiler", tmp_path / "calls"
        script.write_text(
            "#!/bin/sh\n"
            f'[ "$1" = --version ] && echo {shlex.quote(version)} && exit 0\n'
            f'echo "$@" >> {calls}\n'
            'for out in "$@"; do :; done\n'
            f"{body.format(library=kernel_build.path)}\n"
        )
        script.chmod(0o755)
        monkeypatch.setenv("CXX", str(script))
        return lambda: calls.read_text().splitlines() if calls.exists() else []

    return install


def remove_compilers(monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(module, "find_spec", lambda name: None)


def test_kernels_are_compiled_once_and_then_read_from_the_cache(fake_compiler, tmp_path):
    calls = fake_compiler()
    first, second = build(tmp_path / "cache"), build(tmp_path / "cache")
    assert len(calls()) == 1
    assert first.seconds > 0
    assert second.seconds == 0
    assert first.path == second.path
    assert load(second).cadam3d_self_test() == 0
    assert list((tmp_path / "cache").iterdir()) == [first.path], "there are no temporary files"


def test_the_real_compiler_builds_kernels_that_run(kernel_build):
    assert load(kernel_build).cadam3d_self_test() == 0
    # About 3 s on an idle machine, and 0 if an earlier test run has compiled the same sources.
    assert kernel_build.seconds < 60


def test_the_constants_of_the_model_are_passed_to_the_compiler(fake_compiler, tmp_path):
    calls = fake_compiler()
    build(tmp_path / "cache")
    for name in module.CONSTANTS:
        assert f"-DSPLAT_{name}={getattr(module.base, name)!r}" in calls()[0].split()


def test_the_kernels_use_every_constant_of_the_model():
    declared = {name for name, value in vars(module.base).items() if isinstance(value, float)}
    text = "".join((KERNELS / name).read_text(encoding="utf-8") for name in SOURCES)
    assert set(module.CONSTANTS) == declared
    assert not [name for name in declared if not re.search(rf"(?:Real|float|spread)\(SPLAT_{name}\)", text)]


@pytest.mark.parametrize("name", module.CONSTANTS)
def test_another_constant_leads_to_another_build(name, tmp_path, monkeypatch, fake_compiler):
    calls = fake_compiler()
    build(tmp_path / "cache")
    monkeypatch.setattr(module.base, name, getattr(module.base, name) / 2)
    build(tmp_path / "cache")
    assert len(calls()) == 2


@pytest.mark.parametrize("damage", [b"", b"not a library", None])
def test_a_damaged_file_is_built_again(fake_compiler, tmp_path, damage):
    fake_compiler()
    path = build(tmp_path / "cache").path
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2] if damage is None else damage)
    again = build(tmp_path / "cache")
    assert again.seconds > 0
    assert again.path.read_bytes() == content


def test_another_compiler_source_or_machine_leads_to_another_build(fake_compiler, tmp_path, monkeypatch):
    cache = tmp_path / "cache"
    calls = fake_compiler(version="fake 1.0")
    build(cache)
    fake_compiler(version="fake 2.0")
    build(cache)
    assert len(calls()) == 2
    monkeypatch.setattr(module, "_machine", lambda: "another machine")
    build(cache)
    assert len(calls()) == 3
    copy = tmp_path / "kernels"
    copy.mkdir()
    for name in SOURCES:
        (copy / name).write_text((KERNELS / name).read_text() + "\n// changed\n")
    monkeypatch.setattr(module, "KERNELS", copy)
    build(cache)
    assert len(calls()) == 4


def test_two_processes_that_build_at_once_both_get_a_library(fake_compiler, tmp_path):
    # The pause is long enough that neither process finds the result of the other.
    calls = fake_compiler(body="sleep 1; cp {library} $out")
    with multiprocessing.get_context("fork").Pool(2) as twins:
        built = twins.map(build, [tmp_path / "cache"] * 2, chunksize=1)
    assert len(calls()) == 2
    assert built[0].path == built[1].path
    assert list((tmp_path / "cache").iterdir()) == [built[0].path]
    assert load(built[0]).cadam3d_self_test() == 0


def test_a_missing_compiler_is_reported_with_what_to_install(tmp_path, monkeypatch):
    remove_compilers(monkeypatch)
    with pytest.raises(UserError, match=r"apt install g\+\+.*'cadam3d\[compiler\]'"):
        build(tmp_path)


def test_a_cached_library_needs_no_compiler(fake_compiler, tmp_path, monkeypatch):
    fake_compiler()
    built = build(tmp_path / "cache")
    remove_compilers(monkeypatch)
    assert find_cached(tmp_path / "cache", None) == built.path
    assert build(tmp_path / "cache").path == built.path


def test_the_output_of_a_failing_compiler_is_shown(fake_compiler, tmp_path):
    fake_compiler(body="echo 'error: no such thing' >&2; exit 1")
    with pytest.raises(UserError, match=r"(?s)fake 1\.0.*no such thing.*rasterizer=reference"):
        build(tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == []


@pytest.mark.parametrize(
    "body",
    [
        pytest.param("exit 1", id="unknown flag"),
        pytest.param("echo junk > $out; exit 0", id="does not run"),
    ],
)
def test_simpler_flags_are_used_if_the_native_ones_fail(fake_compiler, tmp_path, body):
    calls = fake_compiler(body=f'case "$*" in *native*) {body};; esac; cp {{library}} $out')
    build(tmp_path / "cache")
    assert len(calls()) == len(module.MACHINE_FLAGS)
    assert "native" not in calls()[-1]


def test_a_folder_that_cannot_be_written_is_reported_with_its_key(fake_compiler, tmp_path):
    fake_compiler()
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"rasterizer\.cache_dir="):
        build(tmp_path / "file")


def test_environment_variables_choose_the_compiler_and_the_cache(fake_compiler, tmp_path, monkeypatch):
    fake_compiler(version="fake 3.0")
    compiler = find_compiler()
    assert compiler is not None
    assert compiler.version == "fake 3.0"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_dir() == tmp_path / "cadam3d"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert default_cache_dir().is_absolute()


def test_the_shared_maths_needs_no_header():
    source = (KERNELS / "splat_math.h").read_text()
    assert "#include" not in source, "a run-time CUDA compiler has no headers"


# --- owners of files --------------------------------------------------------------------------------------


@pytest.fixture
def cached(tmp_path) -> Path:
    """Return a file whose name is right, in a folder of this user."""
    folder = tmp_path / "cache"
    folder.mkdir(mode=0o700)
    path = folder / f"rasterizer-{short_hash(b'planted')}.so"
    path.write_bytes(b"planted")
    path.chmod(0o700)
    return path


def test_a_file_that_another_user_can_write_is_not_loaded(cached):
    assert find_intact(cached.parent, "rasterizer-*.so") == cached
    for mode in (0o720, 0o702, 0o777):
        cached.chmod(mode)
        assert find_intact(cached.parent, "rasterizer-*.so") is None


@pytest.mark.parametrize("mode", [0o720, 0o702, 0o777, 0o1777])
def test_a_folder_that_another_user_can_write_is_refused_with_what_to_type(mode, cached):
    assert own_folder(cached.parent, "cpu") == cached.parent
    cached.parent.chmod(mode)
    for call in (lambda: own_folder(cached.parent, "cpu"), lambda: build(cached.parent)):
        with pytest.raises(UserError, match="no other user can write") as caught:
            call()
        advice = "rasterizer.cache_dir=" if mode == 0o1777 else f"chmod go-w {cached.parent}"
        assert f"Try: {advice}" in str(caught.value).replace("rasterizer=cpu rasterizer.", "rasterizer.")


@pytest.mark.parametrize("place", ["folder", "file"])
def test_files_of_another_user_are_refused_also_behind_a_link(place, cached, tmp_path, monkeypatch):
    link = tmp_path / "link"
    link.symlink_to(cached.parent)
    owner = cached.stat().st_uid
    if place == "folder":
        monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
        monkeypatch.setattr("cadam3d.io.cache.ROOT", -1)
        with pytest.raises(UserError, match="belongs to the user with the number"):
            own_folder(link, "cpu")
    else:
        assert own_folder(link, "cpu") == cached.parent
        monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
        monkeypatch.setattr("cadam3d.io.cache.ROOT", -1)
        assert find_intact(link, "rasterizer-*.so") is None


@pytest.mark.parametrize("name", ["circle", "x" * 300])
def test_a_folder_that_the_system_refuses_is_one_message(name, tmp_path):
    (tmp_path / "circle").symlink_to("circle")
    with pytest.raises(UserError, match=r"expected a folder for compiled kernels.*Try: rasterizer=cpu"):
        own_folder(tmp_path / name, "cpu")


def test_a_new_folder_and_a_new_library_belong_to_the_user_alone(fake_compiler, tmp_path):
    fake_compiler()
    before = os.umask(0o002)
    try:
        path = build(tmp_path / "deep/cache").path
    finally:
        os.umask(before)
    assert [place.stat().st_mode & 0o777 for place in (path.parent, path)] == [0o700, 0o700]
    assert build(tmp_path / "deep/cache").path == path
