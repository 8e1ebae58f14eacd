"""Where numbers come from: the commit of a checkout, and the machine."""

import subprocess

import torch

from cadam3d.core.origin import commit, origin_on


def git(folder, *words):
    who = ["-c", "user.name=a", "-c", "user.email=a@b"]
    return subprocess.run(
        ["git", *who, *words], cwd=folder, check=True, capture_output=True, text=True
    ).stdout


def test_a_commit_is_marked_when_its_files_have_changed(tmp_path):
    (tmp_path / "code.py").write_text("a = 1\n")
    git(tmp_path, "init")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "first")
    (tmp_path / "new.txt").touch()
    found = git(tmp_path, "rev-parse", "HEAD")[:7]
    assert commit(tmp_path) == found
    (tmp_path / "code.py").write_text("a = 2\n")
    assert commit(tmp_path) == f"{found}-dirty"


def test_a_package_inside_another_project_has_no_commit(tmp_path):
    git(tmp_path, "init")
    (tmp_path / "site-packages").mkdir()
    assert commit(tmp_path / "site-packages") is None


def test_the_machine_is_named_with_its_cores_and_threads():
    origin = origin_on(torch.device("cpu"))
    assert origin["machine"].endswith(" cores")
    assert origin["threads"] == torch.get_num_threads()
