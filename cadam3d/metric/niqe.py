"""Niqe: how far a picture's statistics are from the statistics of photographs, without any reference."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from cadam3d.core.checks import fail, require_whole
from cadam3d.core.number import Number
from cadam3d.metric import natural
from cadam3d.metric.base import Measurand, Measurement
from cadam3d.metric.scoring import ScoreMetric, Scorer
from cadam3d.metric.transformer import model_facts

OWN_PARAMETERS = Path(__file__).with_name("niqe_parameters.npz")
# The name of these parameters in the record of a number.
OWN_NAME = "cadam3d, from eight photographs"
SMALLEST = 2 * natural.BLOCK  # pixels; four blocks


@dataclass(frozen=True, kw_only=True)
class Niqe(ScoreMetric):
    """The Natural Image Quality Evaluator of Mittal et al. (2013); lower is better.

    The parameters describe pristine photographs. Numbers with different parameters cannot be compared, so the
    record of every number names them. See ``natural`` for what is computed.
    """

    numbers: ClassVar[tuple[Number, ...]] = (
        Number(name="niqe", label="NIQE", digits=3, is_more_better=False),
    )

    parameters: str | None  # a file such as basicsr's niqe_pris_params.npz; None = this package's own

    def prepare(self) -> None:
        """Read the parameters."""
        self.scorer(torch.device("cpu"))

    def scorer(self, device: torch.device) -> Scorer:
        """Return what measures one picture. It computes on the CPU, and ignores the text."""
        require_whole("protocol.size", self.protocol.size, low=SMALLEST)
        file = OWN_PARAMETERS if self.parameters is None else Path(self.parameters).expanduser()
        try:
            pristine = natural.read(file)
        # A damaged file makes its reader raise almost anything.
        except Exception as error:
            expected = "a file such as basicsr's niqe_pris_params.npz"
            raise fail("metric.niqe.parameters", expected=expected, got=self.parameters) from error

        def score(images: Tensor, _text: str) -> Tensor:
            distances = [natural.distance(image, pristine) for image in images.cpu().numpy()]
            return torch.tensor(distances, dtype=torch.float64)

        return Scorer(score=score, facts=model_facts(self.parameters or OWN_NAME, None, [file]))

    def measure(self, measurand: Measurand) -> Measurement:
        """Return ``niqe`` with its record; nothing if no view has two blocks with texture.

        Views with fewer such blocks are left out of the mean, and the record counts them. If the protocol
        aggregates in another way, one such view leaves no number.
        """
        if len(measurand.gaussians) == 0:
            return Measurement({})
        scorer = self.scorer(measurand.gaussians.device)
        values = self.values(measurand, scorer, "")
        known = values[values.isfinite()]
        lost = len(values) - len(known)
        missing = (f"{lost} of {len(values)} views are left out, because they show no texture",)
        warnings = missing if lost else ()
        # A number other than the mean may need every view.
        if len(known) == 0 or (lost and not self.protocol.is_mean):
            return Measurement({}, warnings=warnings)
        facts = {**scorer.facts, "views_left_out": lost}
        return replace(self.measurement(known, None, facts), warnings=warnings)
