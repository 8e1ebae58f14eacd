"""Building native libraries. Most tests use a fake compiler, which copies a small library."""

import ctypes
import multiprocessing
import os
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from cadam3d.compiled import library as module
from cadam3d.compiled.library import (
    FLAGS,
    SIMD,
    Names,
    NativeLibrary,
    build,
    find_cached,
    find_compiler,
    find_intact,
    own_folder,
    short_hash,
)
from cadam3d.core.errors import UserError

NAMES = Names("rasterizer=cpu", fallback="rasterizer=reference")
SOURCE = (
    '#include "answer.h"\nextern "C" __attribute__((visibility("default"))) int test() { return ANSWER; }\n'
)

pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="the fake compiler is a shell script"),
    pytest.mark.skipif(find_compiler() is None, reason="no C++ compiler"),
]


def write_sources(folder: Path, answer: str = "0") -> tuple[Path, ...]:
    folder.mkdir()
    paths = (folder / "small.cpp", folder / "answer.h")
    for path, text in zip(paths, (SOURCE, f"#define ANSWER {answer}\n"), strict=True):
        path.write_text(text)
    return paths


@pytest.fixture
def library(tmp_path) -> NativeLibrary:
    """Return a library of one function, with a header and a definition."""
    return NativeLibrary("small", NAMES, (*write_sources(tmp_path / "sources"), SIMD), ("-DZERO=0",), "test")


@pytest.fixture(scope="module")
def compiled(tmp_path_factory) -> Path:
    """Return the same library, compiled."""
    folder = tmp_path_factory.mktemp("compiled")
    source, *_ = write_sources(folder / "sources")
    command = [*find_compiler().command, *FLAGS, str(source), "-o", str(folder / "small.so")]
    subprocess.run(command, check=True)
    return folder / "small.so"


@pytest.fixture
def fake_compiler(tmp_path, monkeypatch, compiled):
    """Install a compiler that prints its version, records each call in ``calls`` and then runs ``body``."""

    def install(body="cp {library} $out", version="fake 1.0"):
        script, calls = tmp_path / "compiler", tmp_path / "calls"
        script.write_text(
            "#!/bin/sh\n"
            f'[ "$1" = --version ] && echo {shlex.quote(version)} && exit 0\n'
            f'echo "$@" >> {calls}\n'
            'for out in "$@"; do :; done\n'
            f"{body.format(library=compiled)}\n"
        )
        script.chmod(0o755)
        monkeypatch.setenv("CXX", str(script))
        return lambda: calls.read_text().splitlines() if calls.exists() else []

    return install


def remove_compilers(monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(module, "find_spec", lambda name: None)


def test_a_library_is_compiled_once_and_then_read_from_the_cache(library, fake_compiler, tmp_path):
    calls = fake_compiler()
    first, second = build(library, tmp_path / "cache"), build(library, tmp_path / "cache")
    assert len(calls()) == 1
    assert first == second
    assert ctypes.CDLL(str(second)).test() == 0
    assert list((tmp_path / "cache").iterdir()) == [first], "there are no temporary files"


def test_a_library_that_fails_its_own_test_is_refused(library, tmp_path):
    wrong = replace(library, sources=write_sources(tmp_path / "wrong", answer="1"))
    with pytest.raises(UserError, match=r"(?s)^rasterizer=cpu: .*\nexit code 1\n.*=reference$"):
        build(wrong, tmp_path / "cache", machine_flags=((),))


@pytest.mark.parametrize("damage", [b"", b"not a library", None])
def test_a_damaged_file_is_built_again(library, fake_compiler, tmp_path, damage):
    calls = fake_compiler()
    path = build(library, tmp_path / "cache")
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2] if damage is None else damage)
    again = build(library, tmp_path / "cache")
    assert len(calls()) == 2
    assert again.read_bytes() == content


def test_another_compiler_source_or_machine_leads_to_another_build(
    library, fake_compiler, tmp_path, monkeypatch
):
    cache = tmp_path / "cache"
    calls = fake_compiler(version="fake 1.0")
    build(library, cache)
    fake_compiler(version="fake 2.0")
    build(library, cache)
    assert len(calls()) == 2
    monkeypatch.setattr(module, "_machine", lambda: "another machine")
    build(library, cache)
    assert len(calls()) == 3
    for path in library.sources[:2]:
        before = path.read_text()
        path.write_text(before + "\n// changed\n")
        build(library, cache)
        path.write_text(before)
    assert len(calls()) == 5
    changes = ({"definitions": ("-DZERO=1",)}, {"flags": (*FLAGS, "-g")})
    for change in changes:
        build(replace(library, **change), cache)
    assert len(calls()) == 7


def test_two_processes_that_build_at_once_both_get_a_library(library, fake_compiler, tmp_path):
    # The pause is long enough that neither process finds the result of the other.
    calls = fake_compiler(body="sleep 1; cp {library} $out")
    with multiprocessing.get_context("fork").Pool(2) as twins:
        built = twins.starmap(build, [(library, tmp_path / "cache")] * 2, chunksize=1)
    assert len(calls()) == 2
    assert built[0] == built[1]
    assert list((tmp_path / "cache").iterdir()) == [built[0]]
    assert ctypes.CDLL(str(built[0])).test() == 0


def test_a_cached_library_needs_no_compiler(library, fake_compiler, tmp_path, monkeypatch):
    fake_compiler()
    built = build(library, tmp_path / "cache")
    remove_compilers(monkeypatch)
    assert find_cached(library, tmp_path / "cache", None) == built
    assert build(library, tmp_path / "cache") == built


@pytest.mark.parametrize(
    "body",
    [
        pytest.param("exit 1", id="unknown flag"),
        pytest.param("echo junk > $out; exit 0", id="does not run"),
    ],
)
def test_simpler_flags_are_used_if_the_native_ones_fail(library, fake_compiler, tmp_path, body):
    calls = fake_compiler(body=f'case "$*" in *native*) {body};; esac; cp {{library}} $out')
    build(library, tmp_path / "cache")
    assert len(calls()) == len(module.MACHINE_FLAGS)
    assert "native" not in calls()[-1]


def test_a_folder_that_cannot_be_written_is_reported_with_its_key(library, fake_compiler, tmp_path):
    fake_compiler()
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"rasterizer=cpu: expected a folder .* that can be written"):
        build(library, tmp_path / "file")


# --- owners of files --------------------------------------------------------------------------------------


@pytest.fixture
def cached(tmp_path) -> Path:
    """Return a file whose name is right, in a folder of this user."""
    folder = tmp_path / "cache"
    folder.mkdir(mode=0o700)
    path = folder / f"small-{short_hash(b'planted')}.so"
    path.write_bytes(b"planted")
    path.chmod(0o700)
    return path


def test_a_file_that_another_user_can_write_is_not_loaded(cached):
    assert find_intact(cached.parent, "small-*.so") == cached
    for mode in (0o720, 0o702, 0o777):
        cached.chmod(mode)
        assert find_intact(cached.parent, "small-*.so") is None


@pytest.mark.parametrize("mode", [0o720, 0o702, 0o777, 0o1777])
def test_a_folder_that_another_user_can_write_is_refused(library, mode, cached):
    assert own_folder(cached.parent, NAMES) == cached.parent
    cached.parent.chmod(mode)
    for call in (lambda: own_folder(cached.parent, NAMES), lambda: build(library, cached.parent)):
        with pytest.raises(UserError, match=r"no other user can write.* Try: rasterizer=reference$"):
            call()


@pytest.mark.parametrize("place", ["folder", "file"])
def test_files_of_another_user_are_refused_also_behind_a_link(place, cached, tmp_path, monkeypatch):
    link = tmp_path / "link"
    link.symlink_to(cached.parent)
    owner = cached.stat().st_uid
    if place == "folder":
        monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
        monkeypatch.setattr("cadam3d.io.cache.ROOT", -1)
        with pytest.raises(UserError, match="belongs to the user with the number"):
            own_folder(link, NAMES)
    else:
        assert own_folder(link, NAMES) == cached.parent
        monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
        monkeypatch.setattr("cadam3d.io.cache.ROOT", -1)
        assert find_intact(link, "small-*.so") is None


def test_on_windows_where_files_have_no_such_owners_a_library_is_built_and_found(
    library, fake_compiler, tmp_path, monkeypatch
):
    monkeypatch.delattr(os, "geteuid")
    fake_compiler()
    cache = own_folder(tmp_path / "cache", NAMES)
    assert build(library, cache) == find_cached(library, cache, None)


def test_a_new_folder_and_a_new_library_belong_to_the_user_alone(library, fake_compiler, tmp_path):
    fake_compiler()
    before = os.umask(0o002)
    try:
        path = build(library, tmp_path / "deep/cache")
    finally:
        os.umask(before)
    assert [place.stat().st_mode & 0o777 for place in (path.parent, path)] == [0o700, 0o700]
    assert build(library, tmp_path / "deep/cache") == path
