"""ImageReward: how much people would prefer a picture for its prompt, by the package of its authors."""

from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import distributions
from io import StringIO
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from cadam3d.core.errors import UserError
from cadam3d.core.number import Number
from cadam3d.io.image import to_uint8
from cadam3d.io.pretrained import refused_by
from cadam3d.metric.scoring import ScoreMetric, Scorer, too_long
from cadam3d.metric.transformer import downloaded, kept, model_facts

MODULE, PACKAGE = "ImageReward", "image-reward"
NAME = "ImageReward-v1.0"
WEIGHTS, SETTINGS = "ImageReward.pt", "med_config.json"
LONGEST = 35  # tokens that the package reads
# The package does not declare everything that it imports, and some of it must be old.
INSTALL = "pip install '.[image_reward]' openai-clip torchvision 'setuptools<70' 'transformers<4.56'"
# The package reads the vocabulary only from the cache of the hub, so it is downloaded there.
VOCABULARY = "hf download bert-base-uncased config.json tokenizer.json tokenizer_config.json vocab.txt"


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

    model: str  # a folder with WEIGHTS and SETTINGS, or OWNER/NAME on the hub

    def prepare(self) -> None:
        """Import the package, and find the files of the model, after a download if that is necessary."""
        _package()
        self._folder()

    def scorer(self, device: torch.device) -> Scorer:
        """Return the model, which gives each picture a reward."""
        package, folder = _package(), self._folder()
        with refused_by(self._unusable, f"the model in {folder} cannot be loaded"):
            model = kept(_loaded, package, folder, device)
            facts = model_facts(NAME, None, [folder / WEIGHTS])
        installed = next((each.version for each in distributions(name=PACKAGE)), None)

        def score(images: Tensor, text: str) -> Tensor:
            from PIL import Image

            with torch.no_grad():
                rewards = [model.score(text, Image.fromarray(picture)) for picture in to_uint8(images)]
            return torch.tensor(rewards, dtype=torch.float64)

        return Scorer(
            score=score,
            facts={**facts, "package": installed},
            complaints=lambda text: too_long(len(model.blip.tokenizer(text)["input_ids"]), LONGEST),
        )

    def _unusable(self, problem: str) -> UserError:
        return UserError(f"{self.node}.model: {problem}. Try, with a network connection: {VOCABULARY}")

    def _folder(self) -> Path:
        """Return the folder of the model, after a download if it is on the hub and not on this disk."""
        folder = Path(self.model).expanduser()
        if (folder / WEIGHTS).is_file():
            return folder
        return downloaded(f"{self.node}.model", self.model, None, (WEIGHTS, SETTINGS))


def _package() -> Any:
    """Return the package. Raises ``UserError`` if it, or something that it needs, cannot be imported."""

    def refuse(problem: str) -> UserError:
        return UserError(f"{ImageReward.node}: {problem}. Try, in a new environment: {INSTALL}")

    # A package with old requirements fails in many ways beside new libraries.
    with refused_by(refuse, f"the package {PACKAGE} cannot be imported"):
        return import_module(MODULE)


def _loaded(package: Any, folder: Path, device: torch.device) -> Any:
    weights, settings = str(folder / WEIGHTS), str(folder / SETTINGS)
    with redirect_stdout(StringIO()):  # the package prints where it loads from
        return package.load(weights, device=device, download_root=str(folder), med_config=settings)
