"""Pretrained models in the layout of diffusers, in a folder or on the hub, loaded part by part.

A model is a folder with a ``model_index.json``, which names a class for each of its parts. A part (the UNet,
a text encoder, a tokenizer) is loaded separately and when it is needed. Unused parts are never downloaded.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cadam3d.core.checks import fail, require, require_extra
from cadam3d.core.errors import UserError
from cadam3d.core.memory import is_out_of_memory
from cadam3d.io.jsonl import read_json
from cadam3d.io.pickled import require_finite
from cadam3d.io.reading import open_regular

INDEX = "model_index.json"
VOCABULARY = "vocabulary.json"  # in the folder of a model that knows only some words
# The models that come with this package, and the beginning of a path that names one of them. Such a path is
# the same on every machine, so the folder of a run can be moved.
MODELS = Path(__file__).parent.parent / "models"
PACKAGE = "package:"
LIBRARIES = ("diffusers", "transformers")
# The module and the classes of each part. A model cannot choose any other class, because some read code that
# the model brings.
_CLIP_TOKENIZER = ("transformers", ("CLIPTokenizer", "CLIPTokenizerFast"))
CLASSES = {
    "unet": ("diffusers", ("UNet2DConditionModel",)),
    "vae": ("diffusers", ("AutoencoderKL",)),
    "transformer": ("diffusers", ("SD3Transformer2DModel",)),
    "prior": ("diffusers", ("PriorTransformer",)),
    "scheduler": ("diffusers", ("HeunDiscreteScheduler",)),
    "shap_e_renderer": ("diffusers.pipelines.shap_e", ("ShapERenderer",)),
    "text_encoder": ("transformers", ("CLIPTextModel", "CLIPTextModelWithProjection")),
    "text_encoder_2": ("transformers", ("CLIPTextModelWithProjection",)),
    **dict.fromkeys(("tokenizer", "tokenizer_2"), _CLIP_TOKENIZER),
    "text_encoder_3": ("transformers", ("T5EncoderModel",)),
    "tokenizer_3": ("transformers", ("T5Tokenizer", "T5TokenizerFast")),
}
# Keys of a part's configuration that would load further code or other weights.
LOADING = ("attn_implementation", "quantization_config")
EXTRA = ("diffusers", "transformers", "safetensors")
# The weight files of a network on the hub, or their list if there are several, with the name of a variant.
WEIGHTS = tuple(
    f"{stem}.{ending}"
    for stem in ("diffusion_pytorch_model", "model")
    for ending in ("{}.safetensors", "safetensors.index.{}.json")
)
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
        require_extra(self.key, "diffusers", *EXTRA)
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
        return self.entry(part) is not None

    def entry(self, part: str) -> tuple[str, str] | None:
        """Return the library and the class that the index names for a part; None if it names none."""
        found = self.index.get(part)
        if not isinstance(found, list) or [type(each) for each in found] != [str, str]:
            return None
        return found[0], found[1]

    def part(self, name: str, dtype: torch.dtype | None = None) -> Any:
        """Load one part on the CPU; a network is frozen and in evaluation mode.

        Raises ``UserError`` if the part is missing or damaged, or the installed libraries lack its class.
        """
        kind, options = self._kind(name), {"subfolder": name, "revision": self.revision}
        what = f"{name} of {self.where}"
        if dtype is None:
            loaded = read_model(kind, self.where, partial(self._unusable, what), **options)
            if name.startswith("tokenizer"):
                self._check_vocabulary(name, len(loaded))
            return loaded
        self.config(name)
        options |= {"dtype": dtype, "variant": self.variant(name)}
        return read_network(kind, self.where, partial(self._unusable, what), **options)

    def variant(self, name: str) -> str | None:
        """Return the variant of a network's weight files: None if it has only plain ones, as in diffusers.

        Raises ``UserError`` if no part of a folder has files of the variant.
        """
        wanted, folder = self.source.variant, Path(self.where)
        if wanted is None:
            return None
        if not folder.is_dir():
            names = (f"{name}/{file.format(wanted)}" for file in WEIGHTS)
            has = any(fetch_file(self.where, file, self.revision, True)[0] for file in names)
            return wanted if has else None
        parts = {file.parent.name for file in folder.glob(f"*/*.{wanted}[.-]*")}
        key = f"{self.source.key}.variant"
        require(bool(parts), key, expected=f"a variant of {folder}", got=wanted, example=f"{key}=null")
        return wanted if name in parts else None

    def stored(self, name: str) -> int:
        """Return the size of the weight files of a network in bytes; 0 if they are not on this disk."""
        folder = Path(self.where) if Path(self.where).is_dir() else self.file.parent
        for infix in dict.fromkeys((f".{self.source.variant}" if self.source.variant else "", "")):
            wanted = re.compile(rf"(diffusion_pytorch_)?model{re.escape(infix)}(-\d+-of-\d+)?\.safetensors")
            files = [file for file in folder.glob(f"{name}/*") if wanted.fullmatch(file.name)]
            if files:
                return sum(file.stat().st_size for file in files)
        return 0

    def config(self, name: str) -> dict[str, Any]:
        """Return the configuration of one part, without loading its weights."""
        file = "scheduler_config.json" if name == "scheduler" else "config.json"
        place, reason = Path(self.where) / name / file, ""
        if not Path(self.where).is_dir():
            place, reason, _ = fetch_file(self.where, f"{name}/{file}", self.revision, True)
        if place is None:
            raise self._unusable(self.where, f"it has no {name}/{file} ({reason})")
        entries = _read_entries(self.source.key, place)
        if found := [key for key in LOADING if entries.get(key) is not None]:
            raise self._unusable(f"{name} of {self.where}", f"expected no {found[0]} in its {file}")
        return entries

    def skeleton(self, name: str, dtype: torch.dtype) -> Any:
        """Return a network on the meta device, built from its configuration without loading any weights."""
        refuse = partial(self._unusable, f"{name} of {self.where}")
        with refused_by(refuse, "its configuration cannot be used"), torch.device("meta"):
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
        refuse = partial(self._unusable, f"{name} of {self.where}")
        with refused_by(refuse, f"the configuration of its {encoder} cannot be used"):
            wanted = self._kind(encoder).config_class.from_dict(self.config(encoder)).vocab_size
        # The encoder of T5 has room for a few more pieces than its tokenizer has.
        if size < wanted / 2:
            raise refuse(f"it knows {size} of the {wanted} pieces of text")

    def _kind(self, name: str) -> Any:
        """Return the class of a part. Raises ``UserError`` unless the part may have it."""
        place, kinds = CLASSES[name]
        library, kind = self.entry(name) or ("", "")
        if kind not in kinds:
            expected = f"expected a {' or '.join(kinds)}, got {f'{library}.{kind}' if kind else 'nothing'}"
            raise self._unusable(f"{name} of {self.where}", expected)
        return getattr(import_module(place), kind)

    def _unusable(self, what: str, problem: str) -> UserError:
        """Return the error about something that cannot be used."""
        return UserError(f"{self.source.key}: {what}: {problem}. Try: {self.source.key}.path=DIR")


def read_model(kind: Any, where: str | Path, refuse: Callable[[str], UserError], **options: Any) -> Any:
    """Return what a class of diffusers or transformers reads from a folder, or from a model on the hub.

    No code of the model runs, and nothing is asked. ``refuse`` makes the error about whatever goes wrong.
    """
    import diffusers
    import transformers

    diffusers.utils.logging.disable_progress_bar()
    transformers.utils.logging.disable_progress_bar()
    if kind.__module__.startswith("transformers."):
        options["trust_remote_code"] = False
    with refused_by(refuse, f"its {kind.__name__} cannot be loaded"):
        files = [file for file in Path(where, options.get("subfolder", "")).glob("*") if not file.is_dir()]
        for file in files:
            # This refuses a pipe, for which a reader would wait.
            with open_regular(file) as opened:
                if file.suffix == ".bin":
                    require_finite(opened)
        return kind.from_pretrained(where, local_files_only=Path(where).is_dir(), **options)


@contextmanager
def refused_by(refuse: Callable[[str], UserError], problem: str) -> Iterator[None]:
    """Turn the errors of a reader into those of ``refuse``: a damaged file makes it raise almost anything.

    Lack of memory stays what it is.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        if is_out_of_memory(error):
            raise
        raise refuse(f"{problem} ({short(error) or type(error).__name__})") from error


def read_network(kind: Any, where: str | Path, refuse: Callable[[str], UserError], **options: Any) -> Any:
    """Return a network, frozen and on the CPU; see :func:`read_model`."""
    network, report = read_model(kind, where, refuse, output_loading_info=True, **options)
    # With weights of another model, transformers draws the missing ones at random and goes on.
    if missing := sorted(report["missing_keys"]):
        raise refuse(f"it is not a {kind.__name__}: {missing[0]} is missing")
    return network.requires_grad_(False).eval()


def empty(kind: Any, config: Mapping[str, Any]) -> Any:
    """Return a network of a class of diffusers or transformers, before its weights are loaded."""
    if hasattr(kind, "from_config"):
        return kind.from_config(config)
    return kind(kind.config_class.from_dict(config))


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
        with open_regular(file) as opened:
            require_finite(opened)
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
