"""Files that anyone may have written give their content or one message, and never make the program wait."""

import os
from pathlib import Path

import pytest
import yaml

from cadam3d.core.errors import UserError
from cadam3d.io.reading import read_bytes, read_text, read_yaml

BAD_YAML = {
    "an alias": "a: &a [1]\nb: *a\n",
    "a tag": "a: !!python/object/apply:os.getcwd []\n",
    "many levels": "[" * 5000,
    "many closed levels": "[" * 5000 + "]" * 5000,
    "a huge number": "a: " + "1" * 5000 + "\n",
    "an unhashable key": "? [a]\n: b\n",
    "a tab": "a:\n\t- b\n",
    "a null byte": "a: \0\n",
}


@pytest.mark.parametrize("name", BAD_YAML)
def test_yaml_that_is_not_plain_data_is_one_message(tmp_path: Path, name: str) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(BAD_YAML[name], encoding="utf-8")
    with pytest.raises(UserError, match="expected plain YAML") as caught:
        read_yaml(path)
    assert len(str(caught.value).splitlines()) == 1


def test_plain_yaml_is_what_was_written(tmp_path: Path) -> None:
    value = {
        "prompt": "a ${red} torus",
        "steps": 600,
        "sizes": [0.5, None, True],
        "day": "2026-99-99",
        "node": {"a": {}},
    }
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(value).replace("'2026-99-99'", "2026-99-99"), encoding="utf-8")
    assert read_yaml(path) == value


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_named_pipes_and_devices_are_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        with pytest.raises(UserError, match="expected a file, got a"):
            read_bytes(path, largest=10)


@pytest.mark.parametrize("name", ["absent", "x" * 5000, "null\0byte"])
def test_names_that_cannot_be_opened_are_one_message(tmp_path: Path, name: str) -> None:
    with pytest.raises(UserError, match="cannot be read"):
        read_text(tmp_path / name)


def test_text_of_other_encodings_and_large_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "text"
    path.write_bytes(b"\xff\xfe12345678")
    with pytest.raises(UserError, match="UTF-8"):
        read_text(path)
    with pytest.raises(UserError, match="at most 4 bytes"):
        read_bytes(path, largest=4)
    assert len(read_bytes(path, largest=10)) == 10
