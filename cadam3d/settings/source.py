"""Source: read the YAML files of this package quickly, as a source of configuration for Hydra."""

import copy
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import yaml  # comes with OmegaConf
from hydra._internal.core_plugins import file_config_source
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from omegaconf import OmegaConf
from omegaconf._utils import get_yaml_loader

from cadam3d.settings.declared import LOADER, config_dir


class _Loader(LOADER):
    """Reads numbers and dates as OmegaConf does."""

    yaml_implicit_resolvers: ClassVar = get_yaml_loader().yaml_implicit_resolvers


class FileConfigSource(file_config_source.FileConfigSource):
    """Folders of YAML files. Hydra asks for them by paths without a scheme, or with ``file://``.

    A file of this package is parsed once in a process, by the parser in C. The files of users are read by
    Hydra itself, because the parser in C ends the process when data is nested too deeply.

    The class has the name of the one that it replaces: the workers of a launcher receive the table of sources
    and then register Hydra's own ones, which is an error if the class of a scheme has another name.
    """

    def load_config(self, config_path: str) -> ConfigResult:
        """Return the content of a file. Raises ``ConfigLoadError`` if there is none of that name."""
        path = (Path(self.path) / self._normalize_file_name(config_path)).resolve()
        if not path.is_relative_to(config_dir().resolve()) or not path.is_file():
            return super().load_config(config_path)
        text = path.read_text(encoding="utf-8")
        return ConfigResult(
            # Hydra changes what it gets.
            config=copy.deepcopy(_parsed(text)),
            path=f"{self.scheme()}://{self.path}",
            provider=self.provider,
            header=self._get_header_dict(text),
        )


def register_source() -> None:
    """Let Hydra read files with :class:`FileConfigSource`. It is safe to call this again."""
    # Hydra registers its own sources when it finds its plugins, once in a process.
    Plugins.instance()
    SourcesRegistry.instance().types[FileConfigSource.scheme()] = FileConfigSource


@lru_cache(maxsize=1024)
def _parsed(text: str) -> Any:
    return OmegaConf.create(yaml.load(text, Loader=_Loader) or {})
