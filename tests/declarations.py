"""What the metrics of the package declare about their numbers, for files that tests write by hand."""

from dataclasses import replace
from typing import Any

from cadam3d.core.number import Number
from cadam3d.settings.options import option_class, option_names


def all_numbers() -> dict[str, Number]:
    """Return the numbers of all metrics of the package, by name."""
    found = [
        replace(number, metric=name)
        for name in option_names("metric")
        for number in getattr(option_class("metric", name), "numbers", ())
    ]
    return {number.name: number for number in found}


def declared(facts: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of a summary.json or an eval.json with the declarations of its numbers."""
    numbers = {name: each.declaration() for name, each in all_numbers().items() if name in facts}
    return {**facts, "numbers": numbers}
