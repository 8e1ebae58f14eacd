"""ImageReward: how much people would prefer a picture for its prompt, by the package of its authors."""

from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from io import StringIO
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.checks import require
from cadam3d.core.errors import UserError
from cadam3d.core.number import Number
from cadam3d.io.image import to_uint8
from cadam3d.io.pretrained import short
from cadam3d.metric.scoring import ScoreMetric, Scorer, cut_off
from cadam3d.metric.transformer import sha256_of

MODULE, PACKAGE = "ImageReward", "image-reward"
NAME = "ImageReward-v1.0"
WEIGHTS, SETTINGS = "ImageReward.pt", "med_config.json"
# Where the package puts its files, unless it is called with another folder.
CACHE = Path("~/.cache/ImageReward")
LONGEST = 35  # tokens that the package reads
FOLDER = "models/ImageReward"
# The package does not declare everything that it imports, and some of it must be old.
INSTALL = "pip install 'cadam3d[image_reward]' openai-clip torchvision 'setuptools<70' 'transformers<4.56'"
# The package reads the vocabulary only from the cache of the hub, so it is downloaded there.
DOWNLOAD = (
    f"hf download THUDM/ImageReward {WEIGHTS} {SETTINGS} --local-dir {FOLDER} && "
    f"hf download bert-base-uncased config.json tokenizer.json tokenizer_config.json vocab.txt"
)


@dataclass(frozen=True, kw_only=True)
class ImageReward(ScoreMetric):
    """The reward of Xu et al. (2023), about -2 to 2, which their package ``image-reward`` computes.

    The package does not work beside current versions of transformers, so it needs an environment for this
    metric alone (``INSTALL``).
    """

    numbers: ClassVar[tuple[Number, ...]] = (
        Number(name="image_reward", label="ImageReward", digits=3, is_more_better=True, preference=20),
    )
    node: ClassVar[str] = "metric.image_reward"

    model: str | None  # a folder with WEIGHTS and SETTINGS; None = the cache of the package

    def __post_init__(self) -> None:
        require(
            self.model is None or (isinstance(self.model, str) and self.model.strip() != ""),
            f"{self.node}.model",
            expected="a folder or null",
            got=self.model,
            example=f"{self.node}.model=null",
        )

    def prepare(self) -> None:
        """Import the package, and find the files of the model, after a download if that is necessary."""
        package = _package(self.node)
        if NAME in self._named():
            self._load(package, torch.device("cpu"))

    def scorer(self, device: torch.device) -> Scorer:
        """Return the model, which gives each picture a reward."""
        model, sha256 = self._load(_package(self.node), device)
        facts = {"model": NAME, "revision": None, "weights_sha256": sha256, "package": _version()}
        return Scorer(
            score=lambda images, text: _rewards(model, images, text),
            facts=facts,
            complaint=lambda text: _complaint(model, text),
        )

    def _load(self, package: Any, device: torch.device) -> tuple[Any, str]:
        """Return the model and the hash of its weights."""
        try:
            model = _loaded(package, *self._named(), device)
            return model, sha256_of([self._folder() / WEIGHTS])
        # The package, and the libraries below it, raise almost anything.
        except Exception as error:
            if isinstance(error, torch.OutOfMemoryError):
                raise
            raise self._missing(short(error)) from error

    def _named(self) -> tuple[str, str | None, str | None]:
        """Return what the package calls name, download_root and med_config; with NAME, it downloads."""
        folder = self._folder()
        files = (folder / WEIGHTS, folder / SETTINGS)
        if lacking := [file for file in files if not file.is_file()]:
            if self.model is not None:
                raise self._missing(f"{lacking[0]} is missing")
            return NAME, str(folder), None
        return str(files[0]), None, str(files[1])

    def _folder(self) -> Path:
        return (CACHE if self.model is None else Path(self.model)).expanduser()

    def _missing(self, reason: str) -> UserError:
        return UserError(
            f"{self.node}.model: no model is available ({reason}). Try, with a network connection: "
            f"{DOWNLOAD}. Then: {self.node}.model={FOLDER}"
        )


def _package(key: str) -> Any:
    """Return the package. Raises ``UserError`` if it, or something that it needs, cannot be imported."""
    try:
        return import_module(MODULE)
    # A package with old requirements fails in many ways beside new libraries.
    except Exception as error:
        raise UserError(
            f"{key}: the package {PACKAGE} cannot be imported ({short(error)}). "
            f"Try, in a new environment: {INSTALL}"
        ) from error


@lru_cache(maxsize=1)  # it has gigabytes, and all jobs of a sweep need it
def _loaded(package: Any, name: str, root: str | None, settings: str | None, device: torch.device) -> Any:
    with redirect_stdout(StringIO()):  # the package prints where it loads from
        return package.load(name, device=device, download_root=root, med_config=settings)


def _version() -> str | None:
    """Return the version of the package for the record of a number; None if it was not installed by pip."""
    try:
        return version(PACKAGE)
    except PackageNotFoundError:
        return None


def _rewards(model: Any, images: Float[Tensor, "v h w 3"], text: str) -> Float[Tensor, "v"]:
    from PIL import Image

    with torch.no_grad():
        rewards = [model.score(text, Image.fromarray(picture)) for picture in to_uint8(images)]
    return torch.tensor(rewards, dtype=torch.float64)


def _complaint(model: Any, text: str) -> str | None:
    """Return a warning about a text that is too long for the package; None if it reads all of it."""
    return cut_off(len(model.blip.tokenizer(text)["input_ids"]) - LONGEST, LONGEST)
