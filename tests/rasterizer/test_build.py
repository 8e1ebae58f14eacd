"""Building the native kernels: with a compiler that is only played, so that a test costs no compilation."""

import multiprocessing
import re
import shlex
import sys

import pytest

from cadam3d.core.checks import UserError
from cadam3d.io.cache import default_cache_dir
from cadam3d.rasterizer import build as module
from cadam3d.rasterizer.build import (
    KERNELS,
    SOURCES,
    build,
    find_cached,
    find_compiler,
    load,
)

pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="plays a compiler with a shell script"),
    pytest.mark.skipif(find_compiler() is None, reason="no C++ compiler"),
]


@pytest.fixture
def play(tmp_path, monkeypatch, kernel_build):
    """Put a compiler first that says its version, notes each call in ``calls`` and then runs ``body``."""

    def install(body="cp {library} $out", version="played 1.0"):
        script, calls = tmp_path / "play", tmp_path / "calls"
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


def test_compiles_once_and_then_hits_the_cache(play, tmp_path):
    calls = play()
    first, second = build(tmp_path / "cache"), build(tmp_path / "cache")
    assert len(calls()) == 1
    assert first.seconds > 0
    assert second.seconds == 0
    assert first.path == second.path
    assert load(second).cadam3d_self_test() == 0
    assert list((tmp_path / "cache").iterdir()) == [first.path], "nothing is left behind"


def test_the_real_compiler_builds_what_runs(kernel_build):
    assert load(kernel_build).cadam3d_self_test() == 0
    assert 0 < kernel_build.seconds < 60  # about 3 on a machine that has nothing else to do


def test_names_the_constants_of_the_image_formation_model(play, tmp_path):
    calls = play()
    build(tmp_path / "cache")
    for name in module.CONSTANTS:
        assert f"-DSPLAT_{name}={getattr(module.base, name)!r}" in calls()[0].split()


def test_every_constant_of_the_model_reaches_the_kernels():
    declared = {name for name, value in vars(module.base).items() if isinstance(value, float)}
    text = "".join((KERNELS / name).read_text(encoding="utf-8") for name in SOURCES)
    assert set(module.CONSTANTS) == declared
    assert not [name for name in declared if not re.search(rf"(?:Real|float|spread)\(SPLAT_{name}\)", text)]


@pytest.mark.parametrize("name", module.CONSTANTS)
def test_another_constant_means_another_build(name, tmp_path, monkeypatch, play):
    calls = play()
    build(tmp_path / "cache")
    monkeypatch.setattr(module.base, name, getattr(module.base, name) / 2)
    build(tmp_path / "cache")
    assert len(calls()) == 2


@pytest.mark.parametrize("damage", [b"", b"not a library", None])
def test_a_damaged_file_is_built_again(play, tmp_path, damage):
    play()
    path = build(tmp_path / "cache").path
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2] if damage is None else damage)
    again = build(tmp_path / "cache")
    assert again.seconds > 0
    assert again.path.read_bytes() == content


def test_another_compiler_source_or_machine_means_another_build(play, tmp_path, monkeypatch):
    cache = tmp_path / "cache"
    calls = play(version="played 1.0")
    build(cache)
    play(version="played 2.0")
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


def test_two_processes_at_once_both_get_a_library(play, tmp_path):
    calls = play(body="sleep 1; cp {library} $out")  # long enough that neither finds the other's
    with multiprocessing.get_context("fork").Pool(2) as twins:
        built = twins.map(build, [tmp_path / "cache"] * 2, chunksize=1)
    assert len(calls()) == 2
    assert built[0].path == built[1].path
    assert list((tmp_path / "cache").iterdir()) == [built[0].path]
    assert load(built[0]).cadam3d_self_test() == 0


def test_says_what_to_install_where_there_is_no_compiler(tmp_path, monkeypatch):
    remove_compilers(monkeypatch)
    with pytest.raises(UserError, match=r"apt install g\+\+.*'cadam3d\[compiler\]'.*rasterizer=reference"):
        build(tmp_path)


def test_needs_no_compiler_once_built(play, tmp_path, monkeypatch):
    play()
    built = build(tmp_path / "cache")
    remove_compilers(monkeypatch)
    assert find_cached(tmp_path / "cache", None) == built.path
    assert build(tmp_path / "cache").path == built.path


def test_shows_what_a_failing_compiler_said(play, tmp_path):
    play(body="echo 'error: no such thing' >&2; exit 1")
    with pytest.raises(UserError, match=r"(?s)played 1\.0.*no such thing.*rasterizer=reference"):
        build(tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == []


@pytest.mark.parametrize(
    "body",
    [
        pytest.param("exit 1", id="unknown flag"),
        pytest.param("echo junk > $out; exit 0", id="does not run"),
    ],
)
def test_falls_back_to_plainer_flags(play, tmp_path, body):
    calls = play(body=f'case "$*" in *native*) {body};; esac; cp {{library}} $out')
    build(tmp_path / "cache")
    assert len(calls()) == len(module.MACHINE_FLAGS)
    assert "native" not in calls()[-1]


def test_a_folder_that_cannot_be_written_is_the_users_to_choose(play, tmp_path):
    play()
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"rasterizer\.cache_dir="):
        build(tmp_path / "file")


def test_honours_the_users_choices(play, tmp_path, monkeypatch):
    play(version="played 3.0")
    compiler = find_compiler()
    assert compiler is not None
    assert compiler.version == "played 3.0"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_dir() == tmp_path / "cadam3d"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert default_cache_dir().is_absolute()


def test_the_shared_maths_needs_no_header():
    source = (KERNELS / "splat_math.h").read_text()
    assert "#include" not in source, "a run-time CUDA compiler has none"
