"""A fitted number: its value, how sure it is, and whether the data say anything about it."""

from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any


@dataclass(frozen=True, slots=True)
class Estimate:
    """A parameter as the frames show it."""

    value: float
    uncertainty: float
    """One standard deviation; inf where the frames say nothing."""
    determined: bool
    """Whether the frames say anything; otherwise the profile's value is kept."""
    note: str = ""
    """Why not, or on what ground; empty where there is nothing to say."""

    def document(self) -> dict[str, Any]:
        """Return the estimate for JSON, which knows no infinity: null stands for it."""
        known = self.uncertainty if isfinite(self.uncertainty) else None
        return asdict(self) | {"uncertainty": known}
