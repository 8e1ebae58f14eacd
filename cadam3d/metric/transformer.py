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
from cadam3d.io.pretrained import fetch_file

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
        if folder.is_dir():
            if not (folder / CONFIG).is_file():
                raise self._missing(f"{self.model} has no {CONFIG}, so it is not a model of transformers")
            return TransformerFolder(self, folder, None)
        if not self._is_id:
            raise self._missing(f"there is no folder {self.model!r}")
        return self._downloaded()

    @property
    def _is_id(self) -> bool:
        if Path(self.model).expanduser().exists():
            return False
        return self.model.count("/") == 1 and self.model[0] not in "./~" and self.model[-1] != "/"

    def _downloaded(self) -> "TransformerFolder":
        config, reason, can_ask = fetch_file(
            self.model, CONFIG, self.revision, True, lacking="not a model of transformers"
        )
        if config is None:
            raise self._missing(f"no model is available. {self.model}: {reason}")
        try:
            folder = _snapshot(self.model, self.revision, self.needed, can_ask)
        # Also the errors of the hub, which are errors of the operating system.
        except (OSError, ValueError) as error:
            reason = " ".join(str(error).split())[:120]
            raise self._missing(f"no model is available. {self.model}: {reason}") from error
        # In the cache of the hub, the name of a snapshot is its commit.
        return TransformerFolder(self, folder, folder.name)

    def _missing(self, problem: str) -> UserError:
        """Return the error that says what to download, where to put it and what to type."""
        if not self._is_id:
            return UserError(f"{self.name}: {problem}. Try: {self.name}=null")
        return UserError(f"{self.name}: {problem}. Try, with a network connection: {self.download()}")

    def download(self) -> str:
        """Return the line that downloads the model, and the setting that names its folder afterwards."""
        folder = f"models/{self.model.split('/')[1]}"
        revision = "" if self.revision is None else f"--revision {self.revision} "
        only = " ".join(f"--include '{pattern}'" for pattern in self.needed)
        return f"hf download {self.model} {revision}--local-dir {folder} {only}. Then: {self.name}={folder}"


@dataclass(frozen=True)
class TransformerFolder:
    """A model that was found on this disk."""

    source: TransformerSource
    folder: Path
    revision: str | None  # the commit on the hub; None for a folder of the user

    def config(self) -> dict[str, Any]:
        """Return the configuration of the model. Raises ``UserError`` if it cannot be read."""
        entries = self._content(CONFIG)
        if not isinstance(entries, dict):
            raise self.damaged(f"{CONFIG} has no names with values")
        return entries

    def check(self) -> None:
        """Raise ``UserError`` if a file is missing or incomplete. Only headers of weights are read."""
        from safetensors import SafetensorError, safe_open

        self.config()
        for file in self.weights():
            try:
                with safe_open(file, framework="pt"):
                    pass
            except (SafetensorError, OSError) as error:
                raise self.damaged(f"{file.name} is incomplete or damaged ({error})") from error

    def weights(self) -> list[Path]:
        """Return the files of the weights, in the order of their names.

        Raises ``UserError`` if there are none in the format of safetensors.
        """
        single, index = self.folder / WEIGHTS, self.folder / SHARDS
        if single.is_file():
            return [single]
        if not index.is_file():
            raise self.damaged(f"it has no {WEIGHTS}, and no other format is read, since it could run code")
        content = self._content(SHARDS)
        shards = content.get("weight_map") if isinstance(content, dict) else None
        names = sorted(set(shards.values())) if isinstance(shards, dict) else []
        if not names or not all(isinstance(name, str) and Path(name).name == name for name in names):
            raise self.damaged(f"{SHARDS} names no files")
        if lacking := [name for name in names if not (self.folder / name).is_file()]:
            raise self.damaged(f"{lacking[0]} is missing")
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

    def _content(self, name: str) -> Any:
        """Return the content of a JSON file of the model."""
        try:
            return read_json(self.folder / name)
        except UserError as error:
            reason = str(error).partition(" Try: ")[0]
            raise UserError(f"{self.source.name}: {reason} Try: download the model again") from error

    def _unreadable(self, what: str, error: Exception) -> BaseException:
        if isinstance(error, torch.OutOfMemoryError):
            return error
        return self.damaged(f"its {what} cannot be loaded ({' '.join(str(error).split())[:200]})")


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
