"""Models of transformers: one folder each, on this disk or on the hub, with weights that contain no code.

Unlike the models of ``pretrained``, such a folder has no index of parts but a single ``config.json``. Only
weights in the format of safetensors are read. Other formats can run code when they are opened.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, TypeVar

import torch

from cadam3d.core.checks import fail, require_extra
from cadam3d.core.errors import UserError
from cadam3d.io.asset_record import sha256_of
from cadam3d.io.jsonl import read_json
from cadam3d.io.pretrained import EXTRA, read_model, read_network, short

CONFIG = "config.json"
WEIGHTS = "model.safetensors"
SHARDS = "model.safetensors.index.json"
# The files that a model needs; weights in other formats are not downloaded.
NEEDED = ("*.json", "*.txt", WEIGHTS, "model-*.safetensors")
KEPT = 3  # models in memory

Model = TypeVar("Model")


def find_model(key: str, named: str, needed: tuple[str, ...] = NEEDED) -> "TransformerFolder":
    """Find the folder of a model, after a download if it is on the hub and not on this disk.

    ``key`` is the setting that names the model: a folder, or OWNER/NAME or OWNER/NAME@COMMIT on the hub.
    ``needed`` are patterns of the files that are downloaded. Raises ``UserError`` if it cannot be found.
    """
    require_extra(key, "diffusers", *EXTRA)
    model, _, revision = named.partition("@")
    folder = Path(model).expanduser()
    if (folder / CONFIG).is_file():
        return TransformerFolder(key, model, folder, None)
    if folder.exists() or model.count("/") != 1 or model[0] in "./~":
        expected = f"a folder with the {CONFIG} of a model, or OWNER/NAME on the hub"
        raise fail(key, expected=expected, got=model)
    folder = downloaded(key, model, revision or None, needed)
    return TransformerFolder(key, model, folder, folder.name)


@cache  # every job of a sweep needs the model, and asking the hub takes time
def downloaded(key: str, name: str, revision: str | None, needed: tuple[str, ...]) -> Path:
    """Return the folder with the files of a model on the hub that match ``needed``.

    The name of the folder is the commit. Files that are not on this disk are downloaded. Raises ``UserError``
    if that is impossible.
    """
    from huggingface_hub import constants, snapshot_download

    try:
        offline = constants.HF_HUB_OFFLINE
        found = snapshot_download(
            name, revision=revision, allow_patterns=list(needed), local_files_only=offline
        )
    # The errors of the hub are errors of the operating system.
    except (OSError, ValueError) as error:
        folder = f"models/{name.split('/')[1]}"
        commit = f" --revision {revision}" if revision else ""
        raise UserError(
            f"{key}: {name} is not available ({short(error)}). Try, with a network connection: "
            f"hf download {name}{commit} --local-dir {folder}. Then: {key}={folder}"
        ) from error
    return Path(found)


@dataclass(frozen=True)
class TransformerFolder:
    """A model that was found on this disk."""

    # The setting that names the model, such as "metric.clip_score.model", with which messages begin. It is
    # not compared, because the models of several metrics may be the same.
    key: str = field(compare=False)
    model: str  # the folder as it was named, or OWNER/NAME on the hub
    folder: Path
    revision: str | None  # the commit on the hub; None for a folder of the user

    def entries(self, name: str = CONFIG) -> dict[str, Any]:
        """Return the content of a JSON file of the model. Raises ``UserError`` if it cannot be read."""
        try:
            entries = read_json(self.folder / name)
        except UserError as error:
            raise self.damaged(f"{name}: {short(error)}") from error
        if not isinstance(entries, dict):
            raise self.damaged(f"{name}: expected names with values, got other data")
        return entries

    def weights(self) -> list[Path]:
        """Return the files of the weights, in the order of their names.

        Raises ``UserError`` if there are none in the format of safetensors, or if one is incomplete. Only
        their headers are read.
        """
        from safetensors import SafetensorError, safe_open

        names = [WEIGHTS]
        if not (self.folder / WEIGHTS).is_file() and (self.folder / SHARDS).is_file():
            shards = self.entries(SHARDS).get("weight_map")
            names = sorted(set(map(str, shards.values()))) if isinstance(shards, dict) else [WEIGHTS]
        for name in names:
            if not (self.folder / name).is_file():
                raise self.damaged(f"it has no {name}, and no other format is read, since it could run code")
            try:
                with safe_open(self.folder / name, framework="pt"):
                    pass
            except (SafetensorError, OSError) as error:
                raise self.damaged(f"{name} cannot be loaded ({short(error)})") from error
        return [self.folder / name for name in names]

    def load(self, kind: Any, dtype: torch.dtype = torch.float32) -> Any:
        """Return the model as a ``kind`` of transformers: on the CPU, and frozen.

        Raises ``UserError`` if a file is missing or damaged, or if it lacks weights that ``kind`` has.
        """
        self.weights()
        return read_network(kind, self.folder, self.damaged, use_safetensors=True, dtype=dtype)

    def read(self, kind: Any, **options: Any) -> Any:
        """Return what a class of transformers reads from the folder, such as a tokenizer."""
        return read_model(kind, self.folder, self.damaged, **options)

    def facts(self) -> dict[str, Any]:
        """Return what the record of a number says about the model."""
        return model_facts(self.model, self.revision, self.weights())

    def damaged(self, problem: str) -> UserError:
        """Return the error for a model that was found but cannot be used."""
        return UserError(f"{self.key}: {self.model} cannot be used: {problem}")


def model_facts(model: str, revision: str | None, weights: Sequence[Path]) -> dict[str, Any]:
    """Return what the record of a number says about a model with these files of weights."""
    return {"model": model, "revision": revision, "weights_sha256": weights_hash(weights)}


@lru_cache(maxsize=KEPT)
def kept(load: Callable[..., Model], *which: Any) -> Model:
    """Return ``load(*which)``. Several metrics and all jobs of a sweep load each model once.

    With the hash of the weights in ``which``, a file that has changed is loaded again.
    """
    return load(*which)


def weights_hash(files: Sequence[Path]) -> str:
    """Return a hash of the content of files, as hexadecimal digits.

    For one file it is the SHA-256 that ``sha256sum`` prints and the hub shows. For several it is the SHA-256
    of the lines that ``sha256sum`` prints for them, in the order of their names.
    """
    hashes = [(file.name, _hashed(file.resolve(), file.stat().st_mtime_ns)) for file in files]
    if len(hashes) == 1:
        return hashes[0][1]
    lines = "".join(f"{digest}  {name}\n" for name, digest in sorted(hashes))
    return hashlib.sha256(lines.encode()).hexdigest()


@cache  # some files have gigabytes, and several metrics of every job of a sweep need the hash
def _hashed(file: Path, _changed: int) -> str:
    return sha256_of(file)
