"""The figures of a report: every number with its unit, its sigma, and which way is better.

Names are stable: scripts, limits and comparisons are written against them.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.app.report.catalogue import CATALOGUE, Meaning
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.untrusted.values import mapping, number

NOT_A_FIGURE = "has no figure of this name"


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of one session."""

    name: str
    value: float
    sigma: float | None = None
    """1 sigma in the same unit; 0 = exact (a count); None = not known."""

    def __post_init__(self) -> None:
        """Check that there is such a figure and that it has a value.

        Raises:
            InputError: an unknown name, or no finite number.
        """
        if self.name not in CATALOGUE:
            raise InputError(f"a report {NOT_A_FIGURE}: '{self.name}'.")
        if not math.isfinite(self.value):
            raise InputError(f"the figure {self.name} is {self.value}; a number is needed.")
        if self.sigma is not None and not math.isfinite(self.sigma):
            object.__setattr__(self, "sigma", None)

    @property
    def meaning(self) -> Meaning:
        """Return unit, direction and text."""
        return CATALOGUE[self.name]

    @property
    def shown(self) -> str:
        """Return the value with its sigma, without the unit."""
        return shown(self.value, self.sigma)


def count(name: str, value: int) -> Figure:
    """Return an exact figure."""
    return Figure(name=name, value=float(value), sigma=0.0)


def share(name: str, part: int, whole: int) -> Figure:
    """Return a share with the sigma of its binomial, by Agresti and Coull with z = 1.

    sigma = sqrt(p (1 - p) / n') with p = (k + 1/2) / n', n' = n + 1: not 0 where all or none did.
    (Agresti and Coull, The American Statistician 52, 1998.)
    """
    p = (part + 0.5) / (whole + 1)
    return Figure(name=name, value=part / whole, sigma=math.sqrt(p * (1 - p) / (whole + 1)))


def mean_error(values: Array) -> float:
    """Return the standard error of a mean; NaN of fewer than two."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else math.nan


MEDIAN_SCATTER = 1.2533
"""The median of many normal values scatters so many times as much as their mean."""


def shown(value: float, sigma: float | None) -> str:
    """Return a value with its sigma, both to the digits that say something."""
    if sigma is not None and sigma > 0 and math.isfinite(sigma):
        digits = max(0, min(9, 1 - math.floor(math.log10(sigma))))
        return f"{value:.{digits}f} ± {sigma:.{digits}f}"
    if value == int(value) and abs(value) < 1e15 and sigma == 0:
        return f"{int(value)}"
    return f"{value:.4g}"


def require_known(name: str) -> None:
    """Raise if there is no such figure.

    Raises:
        InputError: unknown; lists those that there are.
    """
    if name not in CATALOGUE:
        raise InputError(
            f"a report {NOT_A_FIGURE}: '{name}'. There are: {', '.join(sorted(CATALOGUE))}."
        )


def figures_to_json(figures: Mapping[str, Figure]) -> dict[str, Any]:
    """Return name -> value, unit, sigma (null = not known), better, meaning."""
    return {
        name: {
            "value": f.value,
            "unit": f.meaning.unit,
            "sigma": f.sigma,
            "better": f.meaning.better,
            "meaning": f.meaning.text,
        }
        for name, f in figures.items()
    }


def figures_from_json(value: Any) -> dict[str, Figure]:
    """Return the figures of a stored report; names that this version does not know are left out.

    Raises:
        InputError: not the figures of a report, or in other units; names the field.
    """
    found: dict[str, Figure] = {}
    for name, told in mapping(value, "'figures'").items():
        where = f"'figures.{name:.60}'"
        row = {"value": None, "sigma": math.nan, "unit": None} | mapping(told, where)
        figure_value = number(row["value"], f"{where}.value")
        sigma = row["sigma"]
        sigma = None if sigma is None else number(sigma, f"{where}.sigma", 0.0)
        if name not in CATALOGUE:
            continue
        unit = CATALOGUE[name].unit
        if row["unit"] != unit:
            raise InputError(f"{where} has the unit {row['unit']!r:.60}; '{unit}' is expected.")
        found[name] = Figure(name=name, value=figure_value, sigma=sigma)
    return found
