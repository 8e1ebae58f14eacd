"""A file appears whole or not at all."""

import pytest

from cadam3d.core.errors import UserError
from cadam3d.io.atomic import remove_leftovers, replacing


def test_the_file_appears_only_when_the_block_has_succeeded(tmp_path):
    with replacing(tmp_path / "deep" / "a.txt") as temporary:
        temporary.write_text("new")
        assert not (tmp_path / "deep" / "a.txt").exists()
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a.txt"]
    assert (tmp_path / "deep" / "a.txt").read_text() == "new"


def test_the_temporary_file_keeps_folder_and_suffix(tmp_path):
    with replacing(tmp_path / "a.mp4") as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".mp4")


def test_a_link_with_the_name_of_the_temporary_file_is_replaced_and_not_followed(tmp_path):
    """The name holds the number of the process, so a stranger can prepare links for all numbers."""
    outside = tmp_path / "outside"
    outside.write_text("kept")
    with replacing(tmp_path / "run/a.txt") as temporary:
        name = temporary.name
    (tmp_path / "run" / name).symlink_to(outside)
    with replacing(tmp_path / "run/a.txt") as temporary:
        temporary.write_text("new")
    assert outside.read_text() == "kept"
    assert (tmp_path / "run/a.txt").read_text() == "new"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
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


def test_leftovers_are_removed_and_nothing_else(tmp_path):
    for name in (".tmp-1-a.pt", "a.pt", ".hidden"):
        (tmp_path / name).touch()
    remove_leftovers(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".hidden", "a.pt"]
