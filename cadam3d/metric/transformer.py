"""Models of transformers: one folder each, on this disk or on the hub, with weights that contain no code.

Unlike the models of ``pretrained``, such a folder has no index of parts but a single ``config.json``. Only
weights in the format of safetensors are read. Other formats can run code when they are opened.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from cadam3d.core.checks import require
from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import read_json
from cadam3d.io.pretrained import fetch_file, short

CONFIG = "config.json"
WEIGHTS = "model.safetensors"
SHARDS = "model.safetensors.index.json"
# The files that a model needs; weights in other formats are not downloaded.
NEEDED = ("*.json", "*.txt", WEIGHTS, "model-*.safetensors")
EXTRA = ("transformers", "safetensors", "huggingface_hub")
BLOCK = 1 << 20  # bytes that are hashed at once


@dataclass(frozen=True)
class TransformerSource:
    """The place to search for a model."""

    # The node in the configuration, such as "metric.clip_score", with which messages begin. It is not
    # compared, because the models of several metrics may be the same.
    key: str = field(compare=False)
    model: str  # a folder, or OWNER/NAME on the Hugging Face hub
    revision: str | None  # on the hub; None = the newest
    setting: str = field(default="model", compare=False)  # below the node, the setting that names the model
    needed: Sequence[str] = NEEDED  # patterns of the files that are downloaded

    @property
    def name(self) -> str:
        """Return the whole name of the setting that names the model."""
        return f"{self.key}.{self.setting}"

    def __post_init__(self) -> None:
        require(
            self.model.strip() != "",
            self.name,
            expected="a folder, an id on the hub or null",
            got=self.model,
            example=f"{self.name}=null",
        )

    def find(self) -> "TransformerFolder":
        """Find the folder of the model, after a download if it is on the hub and not on this disk.

        Raises ``UserError``, which says what to download and what to type, if it cannot be found.
        """
        missing = [name for name in EXTRA if find_spec(name) is None]
        if missing:
            raise UserError(f"{self.key}: needs {', '.join(missing)}. Try: pip install 'cadam3d[diffusers]'")
        folder = Path(self.model).expanduser()
        if folder.exists() or self.model.count("/") != 1 or self.model[0] in "./~":
            if (folder / CONFIG).is_file():
                return TransformerFolder(self, folder, None)
            reason = f"it has no {CONFIG}" if folder.is_dir() else "there is no folder of this name"
            raise UserError(
                f"{self.name}: expected a folder with a model of transformers, got {self.model!r} "
                f"({reason}). Try: {self.name}=null"
            )
        folder = self._downloaded()
        # In the cache of the hub, the name of a snapshot is its commit.
        return TransformerFolder(self, folder, folder.name)

    def _downloaded(self) -> Path:
        config, reason, can_ask = fetch_file(self.model, CONFIG, self.revision, True)
        try:
            if config is not None:
                return _snapshot(self.model, self.revision, self.needed, can_ask)
        # Also the errors of the hub, which are errors of the operating system.
        except (OSError, ValueError) as error:
            reason = short(error)
        folder = f"models/{self.model.split('/')[1]}"
        revision = "" if self.revision is None else f"--revision {self.revision} "
        only = " ".join(f"--include '{pattern}'" for pattern in self.needed)
        raise UserError(
            f"{self.name}: no model is available. {self.model}: {reason}. Try, with a network connection: "
            f"hf download {self.model} {revision}--local-dir {folder} {only}. Then: {self.name}={folder}"
        )


@dataclass(frozen=True)
class TransformerFolder:
    """A model that was found on this disk."""

    source: TransformerSource
    folder: Path
    revision: str | None  # the commit on the hub; None for a folder of the user

    def config(self) -> dict[str, Any]:
        """Return the configuration of the model. Raises ``UserError`` if it cannot be read."""
        return self._content(CONFIG)

    def check(self) -> None:
        """Raise ``UserError`` if a file is missing or incomplete. Only headers of weights are read."""
        from safetensors import SafetensorError, safe_open

        self.config()
        for file in self.weights():
            try:
                with safe_open(file, framework="pt"):
                    pass
            except (SafetensorError, OSError) as error:
                raise self.damaged(f"{file.name} is incomplete or damaged ({short(error)})") from error

    def weights(self) -> list[Path]:
        """Return the files of the weights, in the order of their names.

        Raises ``UserError`` if there are none in the format of safetensors.
        """
        names = [WEIGHTS]
        if not (self.folder / WEIGHTS).is_file() and (self.folder / SHARDS).is_file():
            shards = self._content(SHARDS).get("weight_map", {})
            names = sorted({str(name) for name in shards.values()})
        for name in names:
            if not (self.folder / name).is_file():
                raise self.damaged(f"it has no {name}, and no other format is read, since it could run code")
        return [self.folder / name for name in names]

    def load(self, kind: Any, dtype: torch.dtype = torch.float32) -> Any:
        """Return the model as a ``kind`` of transformers: on the CPU, and frozen.

        Raises ``UserError`` if a file is missing or damaged, or if it lacks weights that ``kind`` has.
        """
        import transformers

        self.weights()
        transformers.utils.logging.disable_progress_bar()
        try:
            model, report = kind.from_pretrained(
                self.folder,
                use_safetensors=True,
                dtype=dtype,
                output_loading_info=True,
                trust_remote_code=False,
            )
        except Exception as error:
            raise self._unreadable(kind.__name__, error) from error
        # With weights of another model, transformers draws the missing ones at random and goes on.
        if missing := sorted(report["missing_keys"]):
            raise self.damaged(f"it is not a {kind.__name__}: {missing[0]} is missing")
        return model.requires_grad_(False).eval()

    def read(self, kind: Any) -> Any:
        """Return a tokenizer or image processor from the files of the model, of a class of transformers."""
        try:
            return kind.from_pretrained(self.folder, trust_remote_code=False)
        except Exception as error:
            raise self._unreadable(kind.__name__, error) from error

    def facts(self) -> dict[str, Any]:
        """Return what the record of a number says about the model."""
        return {
            "model": self.source.model,
            "revision": self.revision,
            "weights_sha256": sha256_of(self.weights()),
        }

    def damaged(self, problem: str) -> UserError:
        """Return the error for a model that was found but cannot be used."""
        key, where = self.source.name, self.source.model
        return UserError(f"{key}: {where} cannot be used: {problem}. Try: another {key}")

    def _content(self, name: str) -> dict[str, Any]:
        """Return the content of a JSON file of the model."""
        try:
            entries = read_json(self.folder / name)
        except UserError as error:
            raise self.damaged(str(error).partition(" Try: ")[0]) from error
        if not isinstance(entries, dict):
            raise self.damaged(f"{name} has no names with values")
        return entries

    def _unreadable(self, what: str, error: Exception) -> BaseException:
        if isinstance(error, torch.OutOfMemoryError):
            return error
        return self.damaged(f"its {what} cannot be loaded ({short(error)})")


@cache  # every job of a sweep needs the model, and asking the hub takes time
def _snapshot(name: str, revision: str | None, needed: Sequence[str], can_ask: bool) -> Path:
    """Return the folder of a model of the hub, after a download of what is not on this disk."""
    from huggingface_hub import constants, snapshot_download

    offline = constants.HF_HUB_OFFLINE or not can_ask
    folder = snapshot_download(name, revision=revision, allow_patterns=list(needed), local_files_only=offline)
    return Path(folder)


def sha256_of(files: Sequence[Path]) -> str:
    """Return a hash of the content of files, as hexadecimal digits.

    For one file it is the SHA-256 that ``sha256sum`` prints and the hub shows. For several it is the SHA-256
    of the lines that ``sha256sum`` prints for them, in the order of their names.
    """
    if len(files) == 1:
        return _hash_of_file(files[0])
    lines = [f"{_hash_of_file(file)}  {file.name}\n" for file in sorted(files, key=lambda each: each.name)]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _hash_of_file(file: Path) -> str:
    state = file.stat()
    return _hashed(file.resolve(), state.st_size, state.st_mtime_ns)


@cache  # some files have gigabytes, and several metrics of every job of a sweep need the hash
def _hashed(file: Path, _size: int, _changed: int) -> str:
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        while block := stream.read(BLOCK):
            digest.update(block)
    return digest.hexdigest()
