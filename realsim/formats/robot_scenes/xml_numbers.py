"""Numbers in XML."""

from collections.abc import Iterable


def spaced(values: Iterable[float]) -> str:
    """Return numbers as XML's formats have them; they are read back bit for bit."""
    return " ".join(repr(float(v)) for v in values)
