"""Pretrained models in the layout of diffusers, in a folder or on the hub, loaded part by part.

A model is a folder with a ``model_index.json``, which names a class for each of its parts. A part (the UNet,
a text encoder, a tokenizer) is loaded separately and when it is needed. Unused parts are never downloaded.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cadam3d.core.checks import fail, require
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

    def __post_init__(self) -> None:
        key = self.key
        paths = [self.path] if isinstance(self.path, str) else self.path
        is_path = paths is None or (len(paths) > 0 and all(isinstance(each, str) and each for each in paths))
        wanted = "a folder, a list of folders or null"
        require(is_path, f"{key}.path", expected=wanted, got=self.path, example=f"{key}.path=DIR")
        listed = isinstance(self.ids, Sequence) and not isinstance(self.ids, str)
        require(
            listed and all(isinstance(name, str) and name.count("/") == 1 for name in self.ids),
            f"{key}.ids",
            expected="a list of hub ids, each OWNER/NAME",
            got=self.ids,
            example=f"'{key}.ids=[stabilityai/stable-diffusion-3.5-medium]'",
        )
        for name in ("revision", "variant"):
            value = getattr(self, name)
            is_name = value is None or (isinstance(value, str) and value != "")
            require(
                is_name, f"{key}.{name}", expected="a name or null", got=value, example=f"{key}.{name}=null"
            )

    def find(self, kinds: Sequence[str], others: Mapping[str, str], ask_hub: bool = True) -> "Pretrained":
        """Find the model and read its index; on the hub, the first available id is used.

        ``kinds`` are the accepted pipeline classes; ``others`` maps other classes to what the user should
        type instead. Without ``ask_hub``, only files on this disk count. Raises ``UserError`` if the extra is
        not installed, or with a reason for everything that was tried.
        """
        require_extra(self.key)
        if self.path is None:
            found = self._remote(ask_hub)
        else:
            found = self._local() if isinstance(self.path, str) else self._suitable(self.path, kinds)
        kind = str(found.index.get("_class_name"))
        if kind not in kinds:
            advice = others.get(kind, f"another {self.key}.path")
            raise UserError(
                f"{self.key}: {found.where} is a {kind}, not a {' or '.join(kinds)}. Try: {advice}"
            )
        return found

    def _suitable(self, paths: Sequence[str], kinds: Sequence[str]) -> "Pretrained":
        """Return the first model of a list whose class is one of ``kinds``.

        Raises ``UserError`` if there is none, and if a folder has no model.
        """
        models = [replace(self, path=path)._local() for path in paths]
        suitable = [model for model in models if model.index.get("_class_name") in kinds]
        if not suitable:
            got = ", ".join(f"{model.where} (a {model.index.get('_class_name')})" for model in models)
            raise UserError(
                f"{self.key}.path: expected a {' or '.join(kinds)} in the list, got {got}. "
                f"Try: {self.key}.path=DIR"
            )
        return suitable[0]

    def _local(self) -> "Pretrained":
        path = str(self.path)
        is_packaged = path.startswith(PACKAGE)
        folder = MODELS / path.removeprefix(PACKAGE) if is_packaged else Path(path).expanduser()
        if not (folder / INDEX).is_file():
            expected = f"a folder with a {INDEX} (a model in the layout of diffusers)"
            if is_packaged:
                here = [PACKAGE + index.parent.name for index in sorted(MODELS.glob(f"*/{INDEX}"))]
                expected = f"a model of this installation ({', '.join(here) or 'it has none'})"
            raise fail(f"{self.key}.path", expected=expected, got=path, example=f"{self.key}.path=DIR")
        return Pretrained(self, str(folder), None, folder / INDEX, _read_entries(self.key, folder / INDEX))

    def _remote(self, can_ask: bool) -> "Pretrained":
        require(
            len(self.ids) > 0,
            f"{self.key}.path",
            expected=f"the folder of a model, since {self.key}.ids is empty",
            got=self.path,
            example=f"{self.key}.path=DIR",
        )
        reasons: list[str] = []
        for name in self.ids:
            index, reason, can_ask = fetch_file(name, INDEX, self.revision, can_ask)
            if index is not None:
                return Pretrained(self, name, self.revision, index, _read_entries(self.key, index))
            reasons.append(f"{name}: {reason}")
        folder = f"models/{self.ids[0].split('/')[1]}"
        raise UserError(
            f"{self.key}.ids: no model is available. {'; '.join(reasons)}. Try, with a network connection: "
            f"hf download {self.ids[0]} --local-dir {folder}. Then: {self.key}.path={folder}"
        )


@dataclass(frozen=True)
class Pretrained:
    """A model that was found. :meth:`part` loads its parts."""

    source: ModelSource
    where: str  # a folder, or an id on the hub
    revision: str | None
    file: Path  # the index on this disk
    index: dict[str, Any]

    def has(self, part: str) -> bool:
        """Return whether the model has ``part``, such as ``"text_encoder_3"``."""
        library, kind = (self.index.get(part) or (None, None))[:2]
        return library is not None and kind is not None

    def part(self, name: str, dtype: torch.dtype | None = None) -> Any:
        """Load one part on the CPU; a network is frozen and in evaluation mode.

        Raises ``UserError`` if the part is missing or damaged, or the installed libraries lack its class.
        """
        options: dict[str, Any] = {"subfolder": name, "revision": self.revision}
        if dtype is not None:
            options |= {"dtype": dtype, "variant": self.source.variant}
        _silence()
        try:
            loaded = self._kind(name).from_pretrained(self.where, **options)
        except (OSError, ValueError, KeyError, RuntimeError, TypeError) as error:
            if isinstance(error, torch.OutOfMemoryError):
                raise
            raise UserError(
                f"{self.source.key}: {name} of {self.where} cannot be loaded ({short(error)}). "
                f"Try: download it again, or another {self.source.key}.variant (now {self.source.variant})"
            ) from error
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
            path = Path(self.where) / name / file
            if not path.is_file():
                raise UserError(f"{self.source.key}: {path} is missing. Try: download {self.where} again")
            return _read_entries(self.source.key, path)
        if hasattr(kind, "load_config"):
            return dict(kind.load_config(self.where, subfolder=name, revision=self.revision))
        return kind.config_class.from_pretrained(self.where, subfolder=name, revision=self.revision).to_dict()

    def skeleton(self, name: str, dtype: torch.dtype) -> Any:
        """Return a network on the meta device, built from its configuration without loading any weights."""
        kind, config = self._kind(name), self.config(name)
        usual = torch.get_default_dtype()
        torch.set_default_dtype(dtype)
        try:
            with torch.device("meta"):
                network = (
                    kind.from_config(config)
                    if hasattr(kind, "from_config")
                    else kind(kind.config_class.from_dict(config))
                )
        finally:
            torch.set_default_dtype(usual)
        return network.requires_grad_(False).eval()

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
        files = sorted(path for path in Path(self.where).rglob("*") if path.is_file())
        facts = [(str(f.relative_to(self.where)), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
        return json.dumps([str(Path(self.where).resolve()), facts])

    def _check_vocabulary(self, name: str, size: int) -> None:
        """Raise ``UserError`` if a tokenizer has far fewer pieces of text than its encoder.

        If the files of a tokenizer are missing, transformers silently makes one that knows no word.
        """
        encoder = name.replace("tokenizer", "text_encoder")
        wanted = self._kind(encoder).config_class.from_dict(self.config(encoder)).vocab_size
        # The encoder of T5 has room for a few more pieces than its tokenizer has.
        if size < wanted / 2:
            raise UserError(
                f"{self.source.key}: {name} of {self.where} knows {size} of the {wanted} pieces of text that "
                f"{encoder} reads: files are missing. Try: download it again"
            )

    def _kind(self, name: str) -> Any:
        library, kind = (str(entry) for entry in (self.index.get(name) or (None, None))[:2])
        module = _module(library)
        if module is None or not hasattr(module, kind):
            raise UserError(
                f"{self.source.key}: the {name} of {self.where} is a {library}.{kind}, which the installed "
                f"libraries do not have. Try: pip install -U 'cadam3d[diffusers]', or another model"
            )
        return getattr(module, kind)


def require_extra(key: str) -> None:
    """Raise ``UserError`` unless the libraries for pretrained models are installed."""
    missing = [name for name in EXTRA if find_spec(name) is None]
    if missing:
        raise UserError(f"{key}: needs {', '.join(missing)}. Try: pip install 'cadam3d[diffusers]'")


def _module(library: str) -> Any:
    """Return the module that an index names: a library or a pipeline of diffusers; ``None`` for others."""
    if library in LIBRARIES:
        return import_module(library)
    # Some parts belong to a single pipeline, such as the renderer of Shap-E.
    own = f"diffusers.pipelines.{library}"
    return import_module(own) if library.isidentifier() and find_spec(own) is not None else None


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
        content = _unpickle(file)
        tensors = content.get("state_dict", content)
        return {name: tensor for name, tensor in tensors.items() if torch.is_tensor(tensor)}
    # A damaged file makes its reader raise almost anything.
    except Exception as error:
        raise UserError(
            f"{key}: {file} is not a file of tensors ({short(error)}). "
            f"Try: download it again, or use another {key}"
        ) from error


def _unpickle(file: Path) -> Any:
    try:
        return torch.load(file, map_location="cpu", weights_only=True, mmap=True)
    except RuntimeError:  # an old format that torch cannot map
        return torch.load(file, map_location="cpu", weights_only=True)


def short(error: Exception) -> str:
    """Return the message of another library's error in one line of at most 200 characters."""
    return " ".join(str(error).split())[:200]


def _silence() -> None:
    """Switch off the progress bars of other libraries."""
    import diffusers
    import transformers

    transformers.utils.logging.disable_progress_bar()
    diffusers.utils.logging.disable_progress_bar()
