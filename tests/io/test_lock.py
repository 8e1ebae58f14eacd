"""The lock: one process at a time, a note about that process, and safe handling of the file itself."""

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from cadam3d.core.errors import UserError
from cadam3d.io.lock import INHERITED, describe_holder, holder_name, is_held, locked, process_name, take

REPOSITORY = Path(__file__).parents[2]


def refuse(holder: str) -> UserError:
    return UserError(f"held by {holder}. Try: later")


def test_a_second_process_is_refused_with_the_note_of_the_first(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["anything", "train", "prompt=a cube"])
    with locked(tmp_path / ".lock", refuse):
        with pytest.raises(UserError) as refused, locked(tmp_path / ".lock", refuse):
            pass
        message = str(refused.value)
    assert message.startswith(f"held by process {os.getpid()} on {os.uname().nodename} since ")
    assert "(cadam3d train 'prompt=a cube'). Try: later" in message
    with locked(tmp_path / ".lock", refuse):
        pass
    assert (tmp_path / ".lock").stat().st_size == 0


def test_the_lock_of_a_killed_process_is_free(tmp_path):
    code = "import sys, time; from pathlib import Path; from cadam3d.io.lock import take\n"
    code += "file = take(Path(sys.argv[1])); print('locked', flush=True); time.sleep(60)"
    words = [sys.executable, "-c", code, str(tmp_path / ".lock")]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(REPOSITORY)}
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "locked\n"
        assert take(tmp_path / ".lock") is None
        assert f"process {process.pid} on " in describe_holder(tmp_path / ".lock")
        process.kill()
    assert (tmp_path / ".lock").stat().st_size > 0
    with locked(tmp_path / ".lock", refuse):
        assert f"process {os.getpid()} on " in describe_holder(tmp_path / ".lock")


def test_a_lock_file_that_was_removed_while_it_was_locked_protects_nothing(tmp_path):
    path = tmp_path / ".lock"
    first = take(path)
    assert first is not None
    path.unlink()
    second = take(path)
    assert second is not None
    assert take(path) is None
    first.close()
    assert take(path) is None
    second.close()


@pytest.mark.parametrize(
    "note",
    [
        b"",
        b"not json",
        b"[1]",
        b"{}",
        b"[" * 10_000,
        b"\xff\xfe",
        b"1" * 5_000,
        "\x1b[2J since \n\r \u202e\x00".encode(),
    ],
)
def test_any_note_is_described_in_one_harmless_line(note, tmp_path):
    (tmp_path / ".lock").write_bytes(note)
    description = describe_holder(tmp_path / ".lock")
    assert description.isprintable()
    assert 0 < len(description) < 700


def link(path: Path) -> None:
    path.symlink_to(path.with_name("victim"))


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir, link])
def test_a_lock_file_of_another_kind_is_refused_without_waiting(make, tmp_path):
    make(tmp_path / ".lock")
    with pytest.raises((UserError, IsADirectoryError)):
        take(tmp_path / ".lock")
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]


def test_the_content_of_a_lock_file_changes_only_under_the_lock(tmp_path):
    with locked(tmp_path / ".lock", refuse):
        (tmp_path / ".lock").write_text("the note of another process")
        assert take(tmp_path / ".lock") is None
        assert (tmp_path / ".lock").read_text() == "the note of another process"


def test_only_a_lock_that_was_passed_on_counts_as_free(tmp_path, monkeypatch):
    other = (tmp_path / "other").open("w")
    with other, locked(tmp_path / ".lock", refuse):
        for number in ("", "x", "-1", "9999", "9" * 40, str(other.fileno())):
            monkeypatch.setenv(INHERITED, number)
            assert take(tmp_path / ".lock") is None
    file = take(tmp_path / ".lock")
    assert file is not None
    monkeypatch.setenv(INHERITED, str(file.fileno()))
    with locked(tmp_path / ".lock", refuse):
        pass
    # The process that passed it on still has it.
    monkeypatch.delenv(INHERITED)
    assert take(tmp_path / ".lock") is None
    file.close()


def test_a_file_system_without_locks_does_not_stop_the_work(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("No locks available")

    monkeypatch.setattr("fcntl.flock", fail)
    with locked(tmp_path / ".lock", refuse), locked(tmp_path / ".lock", refuse):
        pass


def test_looking_at_a_lock_changes_nothing(tmp_path):
    path = tmp_path / ".lock"
    assert not is_held(path)
    assert not path.exists()
    with locked(path, refuse):
        note = path.read_text()
        assert is_held(path)
        assert holder_name(path) == process_name()
        assert path.read_text() == note
    assert not is_held(path)
    # A killed process leaves its note behind.
    path.write_text(note)
    assert not is_held(path)
    with locked(path, refuse):
        pass


def test_a_lock_that_is_only_looked_at_does_not_stop_a_process(tmp_path, monkeypatch):
    (tmp_path / ".lock").touch()
    with (tmp_path / ".lock").open() as looking:
        fcntl.flock(looking, fcntl.LOCK_SH)
        monkeypatch.setattr("time.sleep", lambda seconds: fcntl.flock(looking, fcntl.LOCK_UN))
        with locked(tmp_path / ".lock", refuse):
            pass
