"""Pretrained models in the layout of diffusers, in a folder or on the hub, loaded part by part.

A model is a folder with a ``model_index.json``, which names a class for each of its parts. A part (the UNet,
a text encoder, a tokenizer) is loaded separately and when it is needed. Unused parts are never downloaded.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cadam3d.core.checks import fail
from cadam3d.core.errors import UserError
from cadam3d.io.jsonl import read_json

INDEX = "model_index.json"
VOCABULARY = "vocabulary.json"  # in the folder of a model that knows only some words
# The models that come with this package, and the beginning of a path that names one of them. Such a path is
# the same on every machine, so the folder of a run can be moved.
MODELS = Path(__file__).parent.parent / "models"
PACKAGE = "package:"
# Parts may only have classes of these libraries, so that no foreign code runs.
LIBRARIES = ("diffusers", "transformers")
EXTRA = ("diffusers", "transformers", "safetensors")
DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}


@dataclass(frozen=True)
class ModelSource:
    """The places to search for a model. ``key`` is their node in the configuration, for messages."""

    key: str  # such as "prior"
    # A folder, or PACKAGE and a name; or a list of these, of which the first suitable model is used.
    path: str | Sequence[str] | None
    ids: Sequence[str]  # on the Hugging Face hub
    revision: str | None  # on the hub
    variant: str | None  # of the weight files

    def find(self, kinds: Sequence[str], others: Mapping[str, str], ask_hub: bool = True) -> "Pretrained":
        """Find the model and read its index; on the hub, the first available id is used.

        ``kinds`` are the accepted pipeline classes; ``others`` maps other classes to what the user should
        type instead. Without ``ask_hub``, only files on this disk count. Raises ``UserError`` if the extra is
        not installed, or with a reason for everything that was tried.
        """
        require_extra(self.key)
        paths = [self.path] if isinstance(self.path, str) else self.path
        models = [self._remote(ask_hub)] if paths is None else [self._local(path) for path in paths]
        for model in models:
            if model.kind in kinds:
                return model
        got = ", ".join(f"{model.where} (a {model.kind})" for model in models)
        example = others.get(models[0].kind if models else "", f"{self.key}.path=DIR")
        raise fail(f"{self.key}.path", expected=f"a {' or '.join(kinds)}", got=got, example=example)

    def _local(self, path: str) -> "Pretrained":
        is_packaged = path.startswith(PACKAGE)
        folder = MODELS / path.removeprefix(PACKAGE) if is_packaged else Path(path).expanduser()
        index = folder / INDEX
        if not index.is_file():
            expected = f"a folder with a {INDEX}, as diffusers writes it"
            raise fail(f"{self.key}.path", expected=expected, got=path, example=f"{self.key}.path=DIR")
        return Pretrained(replace(self, path=path), str(folder), None, index, _read_entries(self.key, index))

    def _remote(self, can_ask: bool) -> "Pretrained":
        reasons: list[str] = []
        for name in self.ids:
            index, reason, can_ask = fetch_file(name, INDEX, self.revision, can_ask)
            if index is not None:
                return Pretrained(self, name, self.revision, index, _read_entries(self.key, index))
            reasons.append(f"{name}: {reason}")
        first = self.ids[0] if self.ids else "ID"
        raise UserError(
            f"{self.key}.ids: no model is available. {'; '.join(reasons)}. "
            f"Try: hf download {first} --local-dir models, then {self.key}.path=models"
        )


@dataclass(frozen=True)
class Pretrained:
    """A model that was found. :meth:`part` loads its parts."""

    source: ModelSource
    where: str  # a folder, or an id on the hub
    revision: str | None
    file: Path  # the index on this disk
    index: dict[str, Any]

    @property
    def kind(self) -> str:
        """Return the pipeline class that the index names."""
        return str(self.index.get("_class_name"))

    def has(self, part: str) -> bool:
        """Return whether the model has ``part``, such as ``"text_encoder_3"``."""
        return None not in (self.index.get(part) or [None])[:2]

    def part(self, name: str, dtype: torch.dtype | None = None) -> Any:
        """Load one part on the CPU; a network is frozen and in evaluation mode.

        Raises ``UserError`` if the part is missing or damaged, or the installed libraries lack its class.
        """
        options: dict[str, Any] = {"subfolder": name, "revision": self.revision}
        if dtype is not None:
            options |= {"dtype": dtype, "variant": self.source.variant}
        import diffusers
        import transformers

        transformers.utils.logging.disable_progress_bar()
        diffusers.utils.logging.disable_progress_bar()
        try:
            loaded = self._kind(name).from_pretrained(self.where, **options)
        except torch.OutOfMemoryError:
            raise
        except (OSError, ValueError, KeyError, RuntimeError, TypeError) as error:
            raise self._unusable(f"{name} of {self.where} cannot be loaded ({short(error)})") from error
        if isinstance(loaded, torch.nn.Module):
            loaded.requires_grad_(False).eval()
        elif name.startswith("tokenizer"):
            self._check_vocabulary(name, len(loaded))
        return loaded

    def config(self, name: str) -> dict[str, Any]:
        """Return the configuration of one part, without loading its weights."""
        kind = self._kind(name)
        file = "scheduler_config.json" if name == "scheduler" else "config.json"
        if Path(self.where).is_dir():
            return _read_entries(self.source.key, Path(self.where) / name / file)
        if hasattr(kind, "load_config"):
            return dict(kind.load_config(self.where, subfolder=name, revision=self.revision))
        return kind.config_class.from_pretrained(self.where, subfolder=name, revision=self.revision).to_dict()

    def skeleton(self, name: str, dtype: torch.dtype) -> Any:
        """Return a network on the meta device, built from its configuration without loading any weights."""
        with torch.device("meta"):
            network = empty(self._kind(name), self.config(name))
        return network.to(dtype).requires_grad_(False).eval()

    @property
    def name(self) -> str:
        """Return the name of the model for messages, such as ``prior=shapes_sd`` for one of this package."""
        key, path = self.source.key, str(self.source.path)
        return (
            f"{key}={path.removeprefix(PACKAGE)}" if path.startswith(PACKAGE) else f"the model {self.where}"
        )

    def vocabulary(self) -> dict[str, Any] | None:
        """Return the words that the model knows, as it lists them; None for models that read free text."""
        file = self.file.parent / VOCABULARY
        return _read_entries(self.source.key, file) if file.is_file() else None

    @property
    def identity(self) -> str:
        """Return a text that changes with the model: names, sizes and times of files, or the hub's commit."""
        if not Path(self.where).is_dir():
            # In the cache of the hub, the name of a snapshot folder is its commit.
            return f"{self.where}@{self.file.resolve().parent.name}"
        folder = Path(self.where).resolve()
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        return str([(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in files])

    def _check_vocabulary(self, name: str, size: int) -> None:
        """Raise ``UserError`` if a tokenizer has far fewer pieces of text than its encoder.

        If the files of a tokenizer are missing, transformers silently makes one that knows no word.
        """
        encoder = name.replace("tokenizer", "text_encoder")
        wanted = self._kind(encoder).config_class.from_dict(self.config(encoder)).vocab_size
        # The encoder of T5 has room for a few more pieces than its tokenizer has.
        if size < wanted / 2:
            raise self._unusable(f"{name} of {self.where} knows {size} of the {wanted} pieces of text")

    def _kind(self, name: str) -> Any:
        library, kind = (str(entry) for entry in (self.index.get(name) or (None, None))[:2])
        # Some parts belong to a single pipeline, such as the renderer of Shap-E.
        place = library if library in LIBRARIES else f"diffusers.pipelines.{library}"
        has_place = library.isidentifier() and find_spec(place) is not None
        found = getattr(import_module(place), kind, None) if has_place else None
        if found is None:
            raise self._unusable(f"the installed libraries have no {library}.{kind}, its {name}")
        return found

    def _unusable(self, problem: str) -> UserError:
        """Return the error about a part that cannot be used."""
        return UserError(f"{self.source.key}: {problem}. Try: {self.source.key}.path=DIR")


def empty(kind: Any, config: Mapping[str, Any]) -> Any:
    """Return a network of a class of diffusers or transformers, before its weights are loaded."""
    if hasattr(kind, "from_config"):
        return kind.from_config(config)
    return kind(kind.config_class.from_dict(config))


def require_extra(key: str) -> None:
    """Raise ``UserError`` unless the libraries for pretrained models are installed."""
    missing = [name for name in EXTRA if find_spec(name) is None]
    if missing:
        raise UserError(f"{key}: needs {', '.join(missing)}. Try: pip install '.[diffusers]'")


def _read_entries(key: str, file: Path) -> dict[str, Any]:
    entries = read_json(file)
    if not isinstance(entries, dict):
        raise fail(key, expected=f"names with values in {file}", got=entries, example=f"{key}.path=DIR")
    return entries


def fetch_file(name: str, file: str, revision: str | None, can_ask: bool) -> tuple[Path | None, str, bool]:
    """Return a file of a model on the hub, or None and the reason, and whether to ask the hub again."""
    from huggingface_hub import constants, hf_hub_download, utils
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError

    offline = constants.HF_HUB_OFFLINE
    verbosity = utils.logging.get_verbosity()
    # Otherwise the messages about retries would hide ours.
    utils.logging.set_verbosity_error()
    try:
        found = hf_hub_download(name, file, revision=revision, local_files_only=offline or not can_ask)
        return Path(found), "", can_ask
    except LocalEntryNotFoundError:
        why = "HF_HUB_OFFLINE is set" if offline else "the hub cannot be reached"
        # Every further request would take as long.
        return None, f"not on this disk, and {why}", False
    except (HfHubHTTPError, OSError) as error:
        # The hub says whether a model is gated, renamed, or lacks the file or the revision.
        return None, short(error), can_ask
    finally:
        utils.logging.set_verbosity(verbosity)


def read_tensors(key: str, file: Path) -> Mapping[str, Tensor]:
    """Return the tensors of a file by name. If possible the file is mapped, so that only used data is read.

    Nothing in the file is executed. Raises ``UserError``, which names the setting ``key``, if the file cannot
    be read.
    """
    from safetensors.torch import load_file

    try:
        if file.suffix == ".safetensors":
            return load_file(file)
        try:
            content = torch.load(file, map_location="cpu", weights_only=True, mmap=True)
        except RuntimeError:  # an old format that torch cannot map
            content = torch.load(file, map_location="cpu", weights_only=True)
        tensors = content.get("state_dict", content)
        return {name: tensor for name, tensor in tensors.items() if torch.is_tensor(tensor)}
    # A damaged file makes its reader raise almost anything.
    except Exception as error:
        problem = f"{key}: {file} is not a file of tensors ({short(error)})"
        raise UserError(f"{problem}. Try: another {key}") from error


def short(error: Exception) -> str:
    """Return the message of another library's error in one line of at most 200 characters."""
    return " ".join(str(error).split())[:200]
