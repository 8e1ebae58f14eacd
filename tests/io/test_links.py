"""The name of the newest run leads to its folder, with and without links of the system."""

import os

import pytest

from cadam3d.io.links import link
from cadam3d.io.run_folder import expanded, typed_path


@pytest.fixture(params=["links", "no links"])
def names(request, monkeypatch, tmp_path):
    """Return a folder with two runs, on a system that has links or, like Windows for most users, has none."""

    def refused(*_, **__):
        raise OSError(22, "A required privilege is not held by the client")

    monkeypatch.chdir(tmp_path)
    if request.param == "no links":
        monkeypatch.setattr(os, "symlink", refused)
    for run in ("one", "two"):
        (tmp_path / "outputs" / run).mkdir(parents=True)
        (tmp_path / "outputs" / run / "asset.ply").write_text(run)
    return tmp_path / "outputs"


def test_the_name_leads_to_the_newest_run_and_the_files_in_it(names, capsys):
    for run in ("one", "two"):
        link(names / "latest", names / run)
        assert typed_path("outputs/latest") == names / run
        assert expanded("outputs/latest/asset.ply").read_text() == run
        assert expanded("outputs/latest/asset.sog").parent.samefile(names / run)
    assert {path.name for path in names.iterdir()} == {"one", "two", "latest"}
    assert capsys.readouterr().err == ""


def test_both_can_be_moved_together(names, tmp_path):
    link(names / "latest", names / "one")
    names.rename(tmp_path / "moved")
    assert typed_path("moved/latest") == tmp_path / "moved" / "one"


def test_a_file_of_the_user_is_never_replaced(names, capsys):
    (names / "latest").write_text("mine")
    link(names / "latest", names / "one")
    assert (names / "latest").read_text() == "mine"
    assert "not updated (it exists and is not a link)" in capsys.readouterr().err
