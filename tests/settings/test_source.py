"""Hydra's view of the YAML files of this package does not depend on how they are parsed."""

import pytest
from hydra._internal.core_plugins import file_config_source
from hydra._internal.sources_registry import SourcesRegistry
from hydra.errors import HydraException

from cadam3d.core.errors import UserError
from cadam3d.settings.compose import compose, config_dir
from cadam3d.settings.source import FileConfigSource

FOLDER = str(config_dir())


def options() -> list[str]:
    return [str(path.relative_to(FOLDER).with_suffix("")) for path in sorted(config_dir().rglob("*.yaml"))]


def test_every_file_is_read_as_hydra_reads_it_and_a_caller_can_change_what_it_gets():
    own = FileConfigSource("main", FOLDER)
    plain = file_config_source.FileConfigSource("main", FOLDER)
    assert len(options()) > 100
    for option in options():
        expected = plain.load_config(option)
        for _ in range(2):
            found = own.load_config(option)
            # The text of a value distinguishes 1, 1.0, True and "1".
            assert repr(found.config) == repr(expected.config)
            assert (found.header, found.path) == (expected.header, expected.path)
            assert found.provider == expected.provider
            found.config["another key"] = 1


def test_a_changed_file_of_the_package_is_read_again(tmp_path, monkeypatch):
    monkeypatch.setattr("cadam3d.settings.source.config_dir", lambda: tmp_path)
    for number in (1, 2):
        (tmp_path / "a.yaml").write_text(f"key: {number}")
        assert FileConfigSource("main", str(tmp_path)).load_config("a").config.key == number


@pytest.mark.parametrize(
    "text",
    ["1e-3", "1e5", "2024-01-01", ".inf", "1_000", "0x1f", "0o17", "017", "12:30", "on", "'1'", "~", "${a}"],
)
def test_a_value_has_the_type_that_omegaconf_gives_it(text, tmp_path, monkeypatch):
    monkeypatch.setattr("cadam3d.settings.source.config_dir", lambda: tmp_path)
    (tmp_path / "a.yaml").write_text(f"key: {text}")
    found = FileConfigSource("main", str(tmp_path)).load_config("a").config
    expected = file_config_source.FileConfigSource("main", str(tmp_path)).load_config("a").config
    assert repr(found) == repr(expected)


@pytest.mark.parametrize("text", ["[" * 100_000, "a: [1", "a: 1\na: 2", "5"])
def test_a_damaged_file_of_the_user_is_refused(text, tmp_path):
    (tmp_path / "densifier").mkdir()
    (tmp_path / "densifier" / "own.yaml").write_text(f"a: {text}" if text[0] == "[" else text)
    with pytest.raises((UserError, HydraException)):
        compose(["prompt=a", "densifier=own"], search_path=str(tmp_path))


def test_composition_reads_files_with_this_source():
    compose(["prompt=a"])
    assert SourcesRegistry.instance().resolve("file") is FileConfigSource


def test_a_worker_of_a_launcher_registers_its_plugins_after_receiving_this_source():
    compose(["prompt=a"])
    SourcesRegistry.instance().register(file_config_source.FileConfigSource)
    assert SourcesRegistry.instance().resolve("file") is FileConfigSource
