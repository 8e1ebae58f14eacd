"""Pretrained models in the layout of diffusers: found in a folder or on the hub, loaded part by part.

A model is a folder with a ``model_index.json``, which names a class for each of its parts; a part (the UNet,
a text encoder, a tokenizer) is loaded when it is needed and alone: what nobody needs is never downloaded.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from cadam3d.core.checks import UserError, require

INDEX = "model_index.json"
LIBRARIES = ("diffusers", "transformers")  # the only ones that a part may come from: no code of strangers
EXTRA = ("diffusers", "transformers", "safetensors")
DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}


@dataclass(frozen=True)
class Source:
    """Where a model may be found. ``key`` is the node of the configuration that says so, for messages."""

    key: str  # such as "prior"
    path: str | None  # a folder on this machine; it wins over ``ids``
    ids: Sequence[str]  # names on the hub of Hugging Face, tried in order
    revision: str | None  # branch, tag or commit on the hub; None = the newest
    variant: str | None  # of the weight files, such as "fp16"

    def __post_init__(self) -> None:
        key = self.key
        is_path = self.path is None or (isinstance(self.path, str) and self.path != "")
        require(is_path, f"{key}.path", expected="a folder or null", got=self.path, example=f"{key}.path=DIR")
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
        """The model, of which only the index has been read; on the hub, the first id that can be had.

        ``kinds`` are the pipeline classes that will do, ``others`` what to type for those that will not.
        Unless ``ask_hub``, only what is on this disk counts.
        Raises ``UserError`` if the extra is not installed, or with a reason for everything that was tried.
        """
        require_extra(self.key)
        found = self._local() if self.path is not None else self._remote(ask_hub)
        kind = str(found.index.get("_class_name"))
        if kind not in kinds:
            advice = others.get(kind, f"another {self.key}.path")
            raise UserError(
                f"{self.key}: {found.where} is a {kind}, not a {' or '.join(kinds)}. Try: {advice}"
            )
        return found

    def _local(self) -> "Pretrained":
        folder = Path(str(self.path)).expanduser()
        if not (folder / INDEX).is_file():
            what = "nothing there"
            if folder.exists():
                what = f"no {INDEX} in it" if folder.is_dir() else "that is a file"
            raise UserError(
                f"{self.key}.path: expected a folder with a {INDEX} (a model in the layout of diffusers), "
                f"got {str(self.path)!r}: {what}. Try: {self.key}.path=DIR, "
                f"or {self.key}.path=null for {' or '.join(self.ids) or 'the ids (there are none)'}"
            )
        return Pretrained(self, str(folder), None, folder / INDEX, _read_index(self.key, folder / INDEX))

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
            index, reason, can_ask = _fetch_index(name, self.revision, can_ask)
            if index is not None:
                return Pretrained(self, name, self.revision, index, _read_index(self.key, index))
            reasons.append(f"{name}: {reason}")
        folder = f"models/{self.ids[0].split('/')[1]}"
        raise UserError(
            f"{self.key}.ids: no model could be had. {'; '.join(reasons)}. Try, where there is a connection: "
            f"hf download {self.ids[0]} --local-dir {folder}. Then: {self.key}.path={folder}"
        )


@dataclass(frozen=True)
class Pretrained:
    """A model that was found. Its parts are loaded by :meth:`part`."""

    source: Source
    where: str  # the folder, or the id on the hub
    revision: str | None
    file: Path  # the index on this disk
    index: dict[str, Any]

    def has(self, part: str) -> bool:
        """Whether the model comes with ``part``, such as ``"text_encoder_3"``."""
        library, kind = (self.index.get(part) or (None, None))[:2]
        return library is not None and kind is not None

    def part(self, name: str, dtype: torch.dtype | None = None) -> Any:
        """Load one part, in evaluation mode and frozen if it is a network, on the CPU.

        Raises ``UserError`` if the part is missing, damaged or of a class that the installed libraries lack.
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
            reason = " ".join(str(error).split())[:300]
            raise UserError(
                f"{self.source.key}: {name} of {self.where} cannot be loaded ({reason}). "
                f"Try: download it again, or another {self.source.key}.variant (now {self.source.variant})"
            ) from error
        if isinstance(loaded, torch.nn.Module):
            loaded.requires_grad_(False).eval()
        elif name.startswith("tokenizer"):
            self._check_vocabulary(name, len(loaded))
        return loaded

    def config(self, name: str) -> dict[str, Any]:
        """The configuration of one part, without its weights."""
        kind = self._kind(name)
        file = "scheduler_config.json" if name == "scheduler" else "config.json"
        if Path(self.where).is_dir():
            path = Path(self.where) / name / file
            if not path.is_file():
                raise UserError(f"{self.source.key}: {path} is missing. Try: download {self.where} again")
            return _read_index(self.source.key, path)
        if hasattr(kind, "load_config"):
            return dict(kind.load_config(self.where, subfolder=name, revision=self.revision))
        return kind.config_class.from_pretrained(self.where, subfolder=name, revision=self.revision).to_dict()

    def skeleton(self, name: str, dtype: torch.dtype) -> Any:
        """A network without numbers, on the meta device, from its configuration alone: nothing is loaded."""
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
    def identity(self) -> str:
        """A text that changes when the model does: file names, sizes and times, or the commit on the hub."""
        if not Path(self.where).is_dir():
            return f"{self.where}@{self.file.resolve().parent.name}"  # the folder of a snapshot is its commit
        files = sorted(path for path in Path(self.where).rglob("*") if path.is_file())
        facts = [(str(f.relative_to(self.where)), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
        return json.dumps([str(Path(self.where).resolve()), facts])

    def _check_vocabulary(self, name: str, size: int) -> None:
        """Where a tokenizer has no files, transformers makes one up that knows no word, and says nothing."""
        encoder = name.replace("tokenizer", "text_encoder")
        wanted = self._kind(encoder).config_class.from_dict(self.config(encoder)).vocab_size
        if size < wanted / 2:  # T5's encoder has room for a few more pieces than there are
            raise UserError(
                f"{self.source.key}: {name} of {self.where} knows {size} of the {wanted} pieces of text that "
                f"{encoder} reads: files are missing. Try: download it again"
            )

    def _kind(self, name: str) -> Any:
        library, kind = (str(entry) for entry in (self.index.get(name) or (None, None))[:2])
        module = _module(library)
        if module is None or not hasattr(module, kind):
            raise UserError(
                f"{self.source.key}: {self.where} says that its {name} is a {library}.{kind}, which the "
                f"installed libraries do not have. Try: pip install -U 'cadam3d[diffusers]', or another model"
            )
        return getattr(module, kind)


def require_extra(key: str) -> None:
    """Raise ``UserError`` unless the libraries of pretrained models are installed."""
    missing = [name for name in EXTRA if find_spec(name) is None]
    if missing:
        raise UserError(f"{key}: needs {', '.join(missing)}. Try: pip install 'cadam3d[diffusers]'")


def _module(library: str) -> Any:
    """Where an index says that a class lives: a library, or a pipeline of diffusers; None for all else."""
    if library in LIBRARIES:
        return import_module(library)
    own = f"diffusers.pipelines.{library}"  # parts that only one pipeline has, such as Shap-E's renderer
    return import_module(own) if library.isidentifier() and find_spec(own) is not None else None


def _read_index(key: str, file: Path) -> dict[str, Any]:
    try:
        index = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{key}: {file} cannot be read ({error}). Try: download the model again") from error
    if not isinstance(index, dict):
        raise UserError(f"{key}: {file} is no index of a model. Try: download the model again")
    return index


def _fetch_index(name: str, revision: str | None, can_ask: bool) -> tuple[Path | None, str, bool]:
    """The index of a model on the hub, or why there is none; and whether asking the hub is worth the wait."""
    from huggingface_hub import constants, hf_hub_download, utils
    from huggingface_hub.errors import (
        EntryNotFoundError,
        GatedRepoError,
        HfHubHTTPError,
        LocalEntryNotFoundError,
        RepositoryNotFoundError,
        RevisionNotFoundError,
    )

    offline = constants.HF_HUB_OFFLINE
    verbosity = utils.logging.get_verbosity()
    utils.logging.set_verbosity_error()  # its retries would be all that the user sees
    try:
        file = hf_hub_download(name, INDEX, revision=revision, local_files_only=offline or not can_ask)
        return Path(file), "", can_ask
    except GatedRepoError:
        reason = "gated (accept its licence on its page, then: hf auth login)"
    except RevisionNotFoundError:
        reason = f"has no revision {revision!r}"
    except RepositoryNotFoundError:
        reason = "not on the hub (removed, renamed, or private)"
    except LocalEntryNotFoundError:
        reason = (
            f"not on this disk, and {'HF_HUB_OFFLINE is set' if offline else 'the hub cannot be reached'}"
        )
        can_ask = False  # every further question would take as long
    except EntryNotFoundError:
        reason = f"has no {INDEX}: not in the layout of diffusers"
    except (HfHubHTTPError, OSError) as error:
        reason = " ".join(str(error).split())[:120]
    finally:
        utils.logging.set_verbosity(verbosity)
    return None, reason, can_ask


def _silence() -> None:
    """No progress bars of other libraries between ours."""
    import diffusers
    import transformers

    transformers.utils.logging.disable_progress_bar()
    diffusers.utils.logging.disable_progress_bar()
