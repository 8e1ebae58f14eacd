"""Scoring: the base classes of metrics that score the pictures of a protocol one by one.

A ``ScoreMetric`` may score in any way. A ``ModelMetric`` uses a model of transformers, which the protocol or
the metric names.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from cadam3d.core.errors import UserError
from cadam3d.core.number import Number
from cadam3d.io.pretrained import refused_by
from cadam3d.metric.base import Measurand, Measurement, Metric
from cadam3d.metric.protocol import Protocol
from cadam3d.metric.transformer import NEEDED, TransformerFolder, find_model

LEVEL = 0.95  # of the interval


@dataclass(frozen=True)
class Scorer:
    """A model that is ready to score pictures."""

    # From images "v h w 3" in [0, 1] and a text to one score per image, "v", on any device.
    score: Callable[[Tensor, str], Tensor]
    # What the record of a number says about the model: "model", "revision", "weights_sha256" and so on.
    facts: Mapping[str, Any] = field(default_factory=dict)
    # From a text to warnings about it, such as that it is too long for the model.
    complaints: Callable[[str], tuple[str, ...]] = lambda text: ()


@dataclass(frozen=True, kw_only=True)
class ScoreMetric(Metric):
    """One number from the scores of single pictures, which are taken as a protocol says.

    The number is the first of ``numbers``. A subclass returns its model from :meth:`scorer`.
    """

    protocol: Protocol

    @property
    def number(self) -> Number:
        """Return what is declared about the number."""
        return self.numbers[0]

    @abstractmethod
    def scorer(self, device: torch.device) -> Scorer:
        """Return the model, on ``device``. Raises ``UserError`` if its files are missing or damaged."""

    def measure(self, measurand: Measurand) -> Measurement:
        """Return the number, with a record of how it came about; nothing for an asset without Gaussians."""
        if len(measurand.gaussians) == 0:
            return Measurement({})
        scorer = self.scorer(measurand.gaussians.device)
        text = self.protocol.text_of(measurand.prompt)
        values = self.values(measurand, scorer, text)
        self.require_finite(values)
        return replace(self.measurement(values, text, scorer.facts), warnings=scorer.complaints(text))

    def values(self, measurand: Measurand, scorer: Scorer, text: str) -> Float[Tensor, "v"]:
        """Return the score of every view of the protocol. Raises ``UserError`` if the model fails."""
        return torch.cat(
            [self.scores(scorer, images, text) for images in self.protocol.images(measurand.render)]
        )

    def scores(self, scorer: Scorer, images: Float[Tensor, "v h w 3"], text: str) -> Float[Tensor, "v"]:
        """Return the scores of some pictures. Raises ``UserError`` if the model fails."""
        # Models and the preparation of their inputs raise almost any exception.
        with refused_by(UserError, f"metric.{self.number.name}: the model cannot score this prompt"):
            return scorer.score(images, text).detach().double().cpu()

    def require_finite(self, values: Tensor) -> None:
        """Raise ``UserError`` if a model has returned NaN or infinity."""
        if not values.isfinite().all():
            raise UserError(f"metric.{self.number.name}: the model returns NaN or infinity for this prompt")

    def measurement(
        self, values: Float[Tensor, "v"], text: str | None, facts: Mapping[str, Any]
    ) -> Measurement:
        """Return the number that the values of all views become, with its record."""
        value = self.protocol.aggregate(values, less_is_better=not self.number.is_more_better)
        record = {
            "value": value,
            "protocol": self.protocol.record(),
            **facts,
            "text": text,
            "views": [float(each) for each in values],
            "mean": float(values.mean()),
            "interval": self.interval(values) if self.protocol.is_mean else None,
        }
        return Measurement({self.number.name: value}, {self.number.name: record})

    def interval(self, values: Float[Tensor, "v"]) -> dict[str, Any] | None:
        """Return the 95 % interval of the mean over viewpoints; None for fewer than two views.

        It is Student's t interval, which treats the views as a random sample of viewpoints. It says how much
        the choice of the viewpoints matters for this asset, and nothing about other seeds or prompts.
        """
        if len(values) < 2:
            return None
        from scipy.stats import t  # slow to import

        count, mean = len(values), float(values.mean())
        half = float(t.ppf((1 + LEVEL) / 2, count - 1)) * float(values.std()) / math.sqrt(count)
        of = "the mean over viewpoints, by Student's t"
        return {"low": mean - half, "high": mean + half, "level": LEVEL, "of": of}


@dataclass(frozen=True, kw_only=True)
class ModelMetric(ScoreMetric):
    """A score by a model of transformers: the one of the protocol, unless the metric names another one."""

    node: ClassVar[str]  # of the configuration, such as "metric.clip_score"
    kind: ClassVar[str]  # the name of the model in protocols, such as "clip"
    needed: ClassVar[tuple[str, ...]] = NEEDED  # patterns of the files that are downloaded

    model: str | None  # a folder, or OWNER/NAME or OWNER/NAME@COMMIT on the hub; None = the protocol's

    def prepare(self) -> None:
        """Find the files of the model, after a download if necessary, and check that they are complete.

        The weights are not loaded, because they would take memory during training.
        """
        found = self.find()
        found.weights()
        self.check_model(found)

    @abstractmethod
    def check_model(self, found: TransformerFolder) -> None:
        """Raise ``UserError`` if the small files of a model show that it is of another kind or incomplete."""

    def find(self) -> TransformerFolder:
        """Find the folder of the model, after a download if necessary. Raises ``UserError`` if it fails."""
        return find_model(f"{self.node}.model", self.named_model(), self.needed)

    def named_model(self) -> str:
        """Return the name of the model. Raises ``UserError`` if neither metric nor protocol names one."""
        named = self.protocol.models.get(self.kind) if self.model is None else self.model
        if named is None:
            raise UserError(
                f"{self.node}.model: protocol={self.protocol.name} names no model for this metric"
            )
        return named


def too_long(tokens: int, longest: int) -> tuple[str, ...]:
    """Return a warning about a text if it has more tokens than the ``longest`` that the model reads."""
    read = f"the model reads {longest} tokens, and the others of the {tokens} in the text are not scored"
    return (f"{read}. Try: a shorter prompt",) if tokens > longest else ()
