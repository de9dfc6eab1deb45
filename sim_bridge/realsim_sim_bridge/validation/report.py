"""What the validation suite found: checks, each with its figure, its limit and a verdict."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class CheckResult:
    """One figure against its limit."""

    group: str
    """Which part of the suite, one of `CHECKS`."""
    name: str
    """Short and unique in the report."""
    what: str
    """What the figure is, in a sentence."""
    measured: float
    """NaN = it could not be measured, which is a failure."""
    unit: str
    """Of figure and limit; '' = a share or a truth value."""
    limit: float
    at_least: bool = False
    """Whether the figure must be at least the limit; otherwise at most."""
    detail: str = ""
    """What lies behind the figure."""

    @property
    def passed(self) -> bool:
        """Whether the figure keeps its limit; NaN does not."""
        if self.at_least:
            return self.measured >= self.limit
        return self.measured <= self.limit

    def to_json(self) -> dict[str, Any]:
        """Return the check as plain JSON; a figure that is no number becomes null."""
        fields = asdict(self)
        if not np.isfinite(self.measured):
            fields["measured"] = None
        return fields | {"passed": self.passed}


@dataclass(frozen=True, kw_only=True, slots=True)
class LimitRatio:
    """The load at which an engine lets go, in units of the computed limit."""

    group: str
    """'coulomb' or 'torque'."""
    load: str
    """What pulls, e.g. 'x' or '30 mm off along z'."""
    case: str
    """Force and friction, e.g. '20 N, mu 0.25'."""
    held: float
    """Largest share of the limit below which every one tried was held; 0 = not even the least."""
    slipped: float
    """Smallest share from which on every one tried slipped; inf = not even the largest."""

    @property
    def error(self) -> float:
        """The farthest that the engine's limit can be from the computed one, as a share of it."""
        return max(abs(self.held - 1.0), abs(self.slipped - 1.0))


@dataclass(frozen=True, kw_only=True, slots=True)
class ValidationReport:
    """All that was checked of one engine at its settings."""

    engine: str
    version: str
    settings: dict[str, Any]
    """The engine's and the physics' settings as plain JSON."""
    checks: tuple[CheckResult, ...]
    ratios: tuple[LimitRatio, ...]
    """What the limits' checks measured, one a load and case."""
    cpu_s: float
    """Processor time of the suite [s]."""

    @property
    def passed(self) -> bool:
        """Whether every check passed; a suite without checks has not."""
        return bool(self.checks) and all(c.passed for c in self.checks)

    def check(self, name: str) -> CheckResult:
        """Return a check by its name.

        Raises:
            InputError: the report has none of that name.
        """
        for found in self.checks:
            if found.name == name:
                return found
        names = ", ".join(c.name for c in self.checks)
        raise InputError(f"the validation report has no check '{name}'; it has: {names}.")

    def to_rows(self) -> list[tuple[str, str, str, str, str]]:
        """Return the table for a console: verdict, name, figure, limit, detail."""
        rows: list[tuple[str, str, str, str, str]] = []
        for c in self.checks:
            sign = ">=" if c.at_least else "<="
            unit = f" {c.unit}" if c.unit else ""
            rows.append(
                (
                    "pass" if c.passed else "FAIL",
                    c.name,
                    f"{c.measured:.4g}{unit}",
                    f"{sign} {c.limit:.4g}{unit}",
                    c.detail,
                )
            )
        return rows

    def to_json(self) -> dict[str, Any]:
        """Return the whole report as plain JSON."""
        return {
            "engine": self.engine,
            "version": self.version,
            "settings": self.settings,
            "passed": self.passed,
            "cpu_s": round(self.cpu_s, 3),
            "checks": [c.to_json() for c in self.checks],
            "ratios": [
                asdict(r) | {"slipped": r.slipped if np.isfinite(r.slipped) else None}
                for r in self.ratios
            ],
        }
