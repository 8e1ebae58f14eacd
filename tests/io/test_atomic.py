"""A file appears whole or not at all."""

import errno
import shlex
import subprocess

import pytest

from cadam3d.core.errors import UserError
from cadam3d.io.atomic import remove_leftovers, replacing, replacing_series


def test_the_file_appears_only_when_the_block_has_succeeded(tmp_path):
    with replacing(tmp_path / "deep" / "a.txt") as temporary:
        temporary.write_text("new")
        assert not (tmp_path / "deep" / "a.txt").exists()
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a.txt"]
    assert (tmp_path / "deep" / "a.txt").read_text() == "new"


def test_the_temporary_file_keeps_folder_and_suffix(tmp_path):
    with replacing(tmp_path / "a.mp4") as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".mp4")


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, UserError])
def test_a_failing_block_leaves_the_old_file_and_no_other(tmp_path, error):
    (tmp_path / "a.txt").write_text("old")

    def write_half():
        with replacing(tmp_path / "a.txt") as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        write_half()
    assert (tmp_path / "a.txt").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_place_that_cannot_be_written_is_a_user_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="cannot be written"), replacing(tmp_path / "file" / "a.txt"):
        pytest.fail("the block must not start")


@pytest.mark.parametrize("blocked", ["a.txt", "b/c/a.txt", "b/a.txt"])
def test_the_hint_moves_away_what_has_the_name_of_a_file_or_of_its_folder(tmp_path, blocked):
    path = tmp_path / blocked
    if path.parent == tmp_path:
        path.mkdir()
    else:
        (tmp_path / "b").write_text("kept")
    with pytest.raises(UserError) as caught, replacing(path) as temporary:
        temporary.write_text("new")
    hint = str(caught.value).partition("Try: ")[2]
    subprocess.run(shlex.split(hint), check=True)
    with replacing(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"
    assert len(list(tmp_path.iterdir())) == 2


def test_the_hint_of_a_series_moves_away_a_folder_with_the_name_of_a_file(tmp_path):
    def write():
        with replacing_series(tmp_path / "images", lambda name: name.endswith(".png")) as temporary:
            (temporary / "0.png").write_text("new")

    (tmp_path / "images" / "0.png").mkdir(parents=True)
    with pytest.raises(UserError) as caught:
        write()
    subprocess.run(shlex.split(str(caught.value).partition("Try: ")[2]), check=True)
    write()
    assert (tmp_path / "images" / "0.png").read_text() == "new"


@pytest.mark.parametrize(
    ("number", "hint"), [(errno.ENOSPC, "df -h"), (errno.EACCES, "chmod u+w"), (errno.EROFS, "df -h")]
)
def test_the_hint_for_a_full_disk_or_a_protected_folder_names_the_folder(tmp_path, number, hint):
    with pytest.raises(UserError) as caught, replacing(tmp_path / "a.txt"):
        raise OSError(number, "no")
    assert str(caught.value).endswith(f"Try: {shlex.join([*hint.split(), str(tmp_path)])}")


def test_leftovers_are_removed_and_nothing_else(tmp_path):
    for name in (".tmp-1-a.pt", "a.pt", ".hidden"):
        (tmp_path / name).touch()
    remove_leftovers(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".hidden", "a.pt"]
