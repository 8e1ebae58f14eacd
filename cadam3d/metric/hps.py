"""Hps: Human Preference Score v2, how much people would like a picture for its prompt."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import torch

from cadam3d.core.checks import require, require_choice
from cadam3d.core.errors import UserError
from cadam3d.core.number import Number
from cadam3d.io.pretrained import fetch_file, read_tensors, short
from cadam3d.metric.clip import Clip, ClipMetric, assembled, check_clip, load_clip
from cadam3d.metric.open_clip import clip_model
from cadam3d.metric.scoring import Scorer
from cadam3d.metric.transformer import TransformerFolder, TransformerSource, sha256_of

# The file of each version in the repository of the authors, xswu/HPSv2.
FILES = {"v2.0": "HPS_v2_compressed.pt", "v2.1": "HPS_v2.1_compressed.pt"}
SUFFIXES = (".pt", ".pth", ".bin", ".safetensors")
# The files of a CLIP model except its weights, all of which are small.
SMALL = ("*.json", "*.txt")


@dataclass(frozen=True, kw_only=True)
class Hps(ClipMetric):
    """The cosine between a picture and the text, in the space of a CLIP model trained on choices of people.

    Wu et al. (2023) trained OpenCLIP's ViT-H/14 on choices of people, and publish a file with its weights
    under the names of OpenCLIP. The numbers are about 0.2 to 0.3, and those of v2.0 and v2.1 differ. Papers
    often print 100 times this number.
    """

    node: ClassVar[str] = "metric.hps"
    numbers: ClassVar[tuple[Number, ...]] = (
        Number(name="hps", label="HPS v2", digits=3, is_more_better=True, preference=21),
    )
    kind: ClassVar[str] = "hps"

    version: str  # of the file, if the model is an id on the hub: "v2.0" or "v2.1"
    base: str  # a folder or an id, with the configuration, the tokenizer and the preprocessing for a file

    def __post_init__(self) -> None:
        require_choice(f"{self.node}.version", self.version, tuple(FILES))
        require(
            isinstance(self.base, str) and self.base.strip() != "",
            f"{self.node}.base",
            expected="a folder or an id on the hub",
            got=self.base,
            example=f"{self.node}.base=laion/CLIP-ViT-H-14-laion2B-s32B-b79K",
        )

    def prepare(self) -> None:
        """Find the files of the model, after a download if necessary, and check that they are complete."""
        if self._is_folder():
            super().prepare()
        else:
            check_clip(self._base())
            # The file is mapped, so this reads little of it.
            read_tensors(f"{self.node}.model", self._file(self.source())[0])

    def scorer(self, device: torch.device) -> Scorer:
        """Return the model, which gives each picture a score in [-1, 1]."""
        clip = load_clip(self.source(), device) if self._is_folder() else self._from_file(device)
        return clip.scorer()

    def _is_folder(self) -> bool:
        return Path(self.source().model).expanduser().is_dir()

    def _base(self) -> TransformerFolder:
        return TransformerSource(self.node, self.base, None, "base", SMALL).find()

    def _from_file(self, device: torch.device) -> Clip:
        source, base = self.source(), self._base()
        file, revision = self._file(source)
        model = source.model if revision is None else f"{source.model}/{file.name}"
        facts = {"model": model, "revision": revision, "weights_sha256": sha256_of([file])}
        return _loaded(file, base, tuple(facts.items()), device)

    def _file(self, source: TransformerSource) -> tuple[Path, str | None]:
        """Return the file with the weights, and its commit if it is from the hub."""
        file = Path(source.model).expanduser()
        if file.is_file():
            return file, None
        name = FILES[self.version]
        if file.suffix in SUFFIXES or source.model.count("/") != 1:
            raise UserError(
                f"{source.name}: expected a file such as {name}, a folder with a CLIP model of transformers "
                f"or null, got {source.model!r}: nothing there. Try: {source.name}=null"
            )
        found, reason, _ = fetch_file(source.model, name, source.revision, True)
        if found is None:
            raise UserError(
                f"{source.name}: no model is available. {source.model}: {reason}. Try, with a network "
                f"connection: hf download {source.model} {name} --local-dir models. Then: "
                f"{source.name}=models/{name}"
            )
        # In the cache of the hub, the name of the folder of a file is its commit.
        return found, found.parent.name


@lru_cache(maxsize=1)
def _loaded(
    file: Path, base: TransformerFolder, facts: tuple[tuple[str, Any], ...], device: torch.device
) -> Clip:
    """Return the model in a file. ``facts`` has the hash of the file, so a changed file is read again."""
    try:
        model = clip_model(read_tensors(f"{Hps.node}.model", file), base.config())
    except (ValueError, RuntimeError, TypeError, KeyError) as error:
        if isinstance(error, torch.OutOfMemoryError):
            raise
        raise UserError(
            f"{Hps.node}.model: {file} does not fit {Hps.node}.base={base.source.model} ({short(error)}). "
            f"Try: {Hps.node}.model=null"
        ) from error
    return assembled(base, model, dict(facts), device)
