"""Millimetres that read as the same metres, and as the number that a file had.

x = d / 1000 is rounded, and so is x * 1000: 0.1 mm would come back as 0.09999999999999999. Of the
doubles that divide to the same metres the one with the shortest decimal is taken. Decimals of up to
15 digits lie farther apart than those doubles, so whatever had at most 15 digits comes back.
"""

import math

from numpy.typing import ArrayLike

from realsim.records.bop_units import MM_PER_M

STEPS = 3
"""Neighbouring doubles looked at on each side: two roundings move a number by less."""


def exact_mm(metres: float) -> float:
    """Return the shortest decimal [mm] that divides to these metres.

    Not every double is a thousandth of one; then the product is returned, one bit off at most.
    """
    middle = metres * MM_PER_M
    candidates = [middle]
    for direction in (-math.inf, math.inf):
        x = middle
        for _ in range(STEPS):
            x = math.nextafter(x, direction)
            candidates.append(x)
    same = [x for x in candidates if x / MM_PER_M == metres]
    return min(same, key=lambda x: len(repr(x))) if same else middle


def exact_mm_list(metres: ArrayLike) -> list[float]:
    """Return a vector (N,) [m] as shortest decimals [mm]."""
    import numpy as np

    return [exact_mm(float(x)) for x in np.asarray(metres, dtype=np.float64).ravel()]
