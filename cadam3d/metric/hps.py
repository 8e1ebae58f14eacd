"""Hps: Human Preference Score v2, how much people would like a picture for its prompt."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch

from cadam3d.core.checks import fail
from cadam3d.core.errors import UserError
from cadam3d.core.number import Number
from cadam3d.io.pretrained import read_tensors, refused_by
from cadam3d.metric.clip import Clip, ClipMetric, assembled, check_clip
from cadam3d.metric.open_clip import clip_model
from cadam3d.metric.scoring import Scorer
from cadam3d.metric.transformer import TransformerFolder, downloaded, find_model, kept, model_facts

# The files of a CLIP model except its weights, all of which are small.
SMALL = ("*.json", "*.txt")


@dataclass(frozen=True, kw_only=True)
class Hps(ClipMetric):
    """The cosine between a picture and the text, in the space of a CLIP model trained on choices of people.

    Wu et al. (2023) trained OpenCLIP's ViT-H/14 on choices of people, and publish a file with its weights
    under the names of OpenCLIP. The numbers are about 0.2 to 0.3, and differ between v2.0 and v2.1. Papers
    often print 100 times this number.
    """

    node: ClassVar[str] = "metric.hps"
    numbers: ClassVar[tuple[Number, ...]] = (
        Number(name="hps", label="HPS v2", digits=3, is_more_better=True, preference=21),
    )
    kind: ClassVar[str] = "hps"

    base: str  # a folder or an id, with the configuration, the tokenizer and the preprocessing for a file

    def prepare(self) -> None:
        """Find the files of the model, after a download if necessary, and check that they are complete."""
        check_clip(self._base())
        # The file is mapped, so this reads little of it.
        read_tensors(f"{self.node}.model", self._file()[0])

    def scorer(self, device: torch.device) -> Scorer:
        """Return the model, which gives each picture a score in [-1, 1]."""
        file, name, revision = self._file()
        facts = model_facts(name, revision, [file])
        return kept(_loaded, file, self._base(), tuple(facts.items()), device).scorer()

    def _base(self) -> TransformerFolder:
        return find_model(f"{self.node}.base", self.base, SMALL)

    def _file(self) -> tuple[Path, str, str | None]:
        """Return the file with the weights, its name in records, and its commit if it is from the hub."""
        key, (model, _, revision) = f"{self.node}.model", self.named_model().partition("@")
        file = Path(model).expanduser()
        if file.is_file():
            return file, model, None
        repository, _, name = model.rpartition("/")
        if repository.count("/") != 1:
            raise fail(key, expected="a file, or OWNER/NAME/FILE on the hub", got=model)
        folder = downloaded(key, repository, revision or None, (name,))
        return folder / name, model, folder.name


def _loaded(
    file: Path, base: TransformerFolder, facts: tuple[tuple[str, str | None], ...], device: torch.device
) -> Clip:
    """Return the model in a file. ``facts`` has the hash of the file, so a changed file is read again."""
    with refused_by(UserError, f"{Hps.node}.model: {file} does not fit {Hps.node}.base={base.model}"):
        model = clip_model(read_tensors(f"{Hps.node}.model", file), base.entries())
    return assembled(base, model, dict(facts), device)
