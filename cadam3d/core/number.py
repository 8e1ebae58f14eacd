"""Number: how a number that describes an asset is printed, and whether more or less of it is better."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Number:
    """The declaration of a number that a metric measures.

    The declaration is kept beside the number in ``summary.json`` and ``eval.json``, so that tables, reports
    and ``select=`` need no list of metrics.
    """

    name: str  # in summary.json and eval.json
    label: str  # for columns and within sentences
    unit: str = ""  # empty if there is none
    digits: int  # after the point
    is_more_better: bool | None  # None = neither more nor less is better
    explained: str = ""  # a longer label with its unit, for lists of facts; empty = the heading
    # Without select=, the number with the lowest preference decides which attempt is the best; None = never
    # this one. Comparisons with the truth have 10 to 19, preferences of people 20 to 29, agreement with the
    # prompt 30 to 39.
    preference: int | None = None
    replaces: str = (
        ""  # the number instead of which this one counts if both are known; empty if there is none
    )
    needs_truth: bool = False  # whether it compares the asset with the true object
    metric: str = ""  # the option of ``metric=`` that measures it; empty until that is chosen

    @property
    def heading(self) -> str:
        """Return the label with its unit, such as ``PSNR (dB)``."""
        return f"{self.label} ({self.unit})" if self.unit else self.label

    @property
    def fact(self) -> str:
        """Return the label for a list of facts, such as ``Median scale (world units)``."""
        text = self.explained or self.heading
        return text[0].upper() + text[1:]

    def written(self, value: float) -> str:
        """Return a value as text with its unit, such as ``23.41 dB``."""
        return f"{value:,.{self.digits}f} {self.unit}".rstrip()

    def merit(self, value: float) -> float:
        """Return a number that is larger for a better value. Requires that more or less is better."""
        assert self.is_more_better is not None
        return value if self.is_more_better else -value

    def declaration(self) -> dict[str, Any]:
        """Return what differs from the defaults, without the name, as plain data for a file."""
        defaults = {field.name: field.default for field in fields(self)}
        return {key: value for key, value in asdict(self).items() if key != "name" and value != defaults[key]}


def preferred(numbers: Iterable[Number]) -> list[Number]:
    """Return the numbers that may decide which asset is the best, the most preferred first, each once.

    A number comes after the one that replaces it.
    """
    found = {each.name: each for each in numbers if each.preference is not None}
    return sorted(found.values(), key=lambda each: (each.preference, not each.replaces, each.name))


# The number that every summary has, whichever metrics were chosen.
COUNT = Number(name="num_gaussians", label="Gaussians", digits=0, is_more_better=False)
