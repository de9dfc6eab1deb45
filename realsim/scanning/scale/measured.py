"""One edge measured by hand: the scale it gives, and whether the fit agrees with it.

A caliper knows nothing of cameras and arms, so it is the one check of a scale that shares no error
with the session. What it measures has to be found on the mesh without a word being ambiguous:

    longest    longest side of the smallest box around the mesh, however the box is turned
    x, y, z    size along one of the mesh's own axes
    diameter   greatest distance between any two points (BOP's diameter, not that of a round body)
    height     size along the direction that is up: out of the table where a session says which way
               the object stands, the mesh's own z otherwise
    between    distance of two points given in the mesh's own numbers
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError, UnitError
from realsim.records import Mesh

Point = tuple[float, float, float]
Kind = Literal["longest", "x", "y", "z", "diameter", "height", "between"]
KINDS: tuple[Kind, ...] = ("longest", "x", "y", "z", "diameter", "height", "between")
KIND_OF: dict[str, Kind] = dict(zip(KINDS, KINDS, strict=True))
UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254, "in": 0.0254}
"""Units a length may be given in [m]; without one of them a number is no length."""
AXES: dict[str, int] = {"x": 0, "y": 1, "z": 2}
MEANING: dict[Kind, str] = {
    "longest": "longest side of the smallest box around the mesh",
    "x": "size along the mesh's x axis",
    "y": "size along the mesh's y axis",
    "z": "size along the mesh's z axis",
    "diameter": "greatest distance between any two points",
    "height": "size along the upward direction",
    "between": "distance between the two given points",
}
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
LENGTH = rf"({NUMBER})\s*([a-z]*)"
SIGMA_M = 0.0005
"""1-sigma of a length given without one [m]. A caliper reads 0.02 mm, but on a rounded or soft
body the jaws sit where the hand puts them: repeats differ by about half a millimetre."""
AGREE_Z = 2.6
"""Two figures agree when they differ by less than this many of their joint sigmas: one right
pair in a hundred is called wrong."""
LEAST_M = 0.002
"""Shorter lengths [m] are typing errors: nothing that a gripper grasps is so small."""
GREATEST_M = 3.0
"""Longer ones [m] are: nothing on a table is so large."""
LARGEST_SIGMA = 0.2
"""A sigma beyond this share of the length is a typing error: it would check nothing."""
TYPO_TOLERANCE = 0.05
"""A wrong unit is named when the ratio is within this of its factor; the factors lie further
apart, and no fit that is worth comparing is off by more."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Measurement:
    """A length that somebody measured on the real object."""

    kind: Kind
    value_m: float
    """[m]."""
    sigma_m: float
    """1-sigma [m]."""
    points: tuple[Point, Point] | None = None
    """The two points of 'between', in the mesh's own units; None for the other kinds."""

    @property
    def text(self) -> str:
        """What was measured, for a person."""
        ends = "" if self.points is None else " " + " ".join(_written(p) for p in self.points)
        return f"{self.kind}{ends} = {1e3 * self.value_m:.5g} +- {1e3 * self.sigma_m:.2g} mm"


@dataclass(frozen=True, kw_only=True, slots=True)
class LengthScale:
    """What one measurement alone says of the scale."""

    measurement: Measurement
    length: float
    """The same length on the mesh [units of the mesh]."""
    scale: float
    """Metres per unit of the mesh."""
    sigma: float
    """1-sigma of it [metres per unit]."""


def parse_measurement(text: str) -> Measurement:
    """Return the measurement of a text such as 'longest=120.4mm' or 'height=95mm+-0.3mm'.

    Two points are written 'between 0,0,0 0.3,0,1=95mm'.

    Raises:
        InputError: no such kind, points that are none, or no length.
        UnitError: a number without a unit, or a length that no object on a table has.
    """
    name, equals, rest = text.partition("=")
    words = name.split()
    if not equals or not words:
        raise InputError(
            f"'{text}' is no measured length; 'longest=120.4mm', 'height=95mm+-0.3mm' or "
            "'between 0,0,0 0.3,0,1=95mm' is."
        )
    kind = KIND_OF.get(words[0].lower())
    if kind is None:
        known = "; ".join(f"{k}: {MEANING[k]}" for k in KINDS)
        raise InputError(f"'{words[0]}' in '{text}' cannot be measured; these can: {known}.")
    points = _points(words[1:], kind, text)
    value, *more = re.split(r"\+/?-|±", rest)
    value_m, unit = _length(value, text)
    if len(more) > 1:
        raise InputError(f"'{text}' has several '+-'; one length and one sigma are expected.")
    sigma_m = _length(more[0], text, unit)[0] if more else SIGMA_M
    if not LEAST_M <= value_m <= GREATEST_M:
        raise UnitError(
            f"'{text}' says {value_m:.4g} m; between {1e3 * LEAST_M:g} mm and "
            f"{GREATEST_M:g} m is accepted. Is the unit right?"
        )
    if not 0 < sigma_m <= LARGEST_SIGMA * value_m:
        raise InputError(
            f"'{text}' has a sigma of {1e3 * sigma_m:.4g} mm on {1e3 * value_m:.4g} mm; more than "
            f"0 and at most {100 * LARGEST_SIGMA:g} % of the length is accepted."
        )
    return Measurement(kind=kind, value_m=value_m, sigma_m=sigma_m, points=points)


def parse_length(text: str) -> float:
    """Return a plain length such as '90mm' [m].

    Raises:
        InputError: it is no length.
        UnitError: no unit, or no object on a table is of that size.
    """
    return parse_measurement(f"longest={text}").value_m


def _length(text: str, whole: str, unit: str = "") -> tuple[float, str]:
    """Return a length [m] and the unit it was written in; `unit` stands where none is written."""
    found = re.fullmatch(LENGTH, text.strip().lower())
    if found is None:
        raise InputError(f"'{text.strip()}' in '{whole}' is no length; '120.4mm' is one.")
    written = found[2] or unit
    if written not in UNITS_M:
        said = f"the unit '{written}'" if written else "no unit"
        raise UnitError(
            f"'{text.strip()}' in '{whole}' has {said}; {', '.join(UNITS_M)} are known. Write "
            f"{found[1]}mm if it is in millimetres."
        )
    return float(found[1]) * UNITS_M[written], written


def _points(words: Sequence[str], kind: Kind, text: str) -> tuple[Point, Point] | None:
    """Return the two points of 'between', None for every other kind."""
    if kind != "between":
        if words:
            raise InputError(f"'{' '.join(words)}' in '{text}' is not understood after '{kind}'.")
        return None
    ends: list[Point] = []
    for word in words:
        parts = word.split(",")
        if len(parts) != 3 or not all(re.fullmatch(NUMBER, p.strip()) for p in parts):
            raise InputError(
                f"'{word}' in '{text}' is no point; x,y,z without spaces, in the mesh's own "
                "numbers, is one."
            )
        x, y, z = (float(p) for p in parts)
        ends.append((x, y, z))
    if len(ends) != 2 or ends[0] == ends[1]:
        raise InputError(
            f"'{text}' names {len(ends)} points; two different ones are needed: "
            "'between 0,0,0 0.3,0,1=95mm'."
        )
    return ends[0], ends[1]


def _written(point: Point) -> str:
    return ",".join(f"{v:.6g}" for v in point)


def length_of(mesh: Mesh, measurement: Measurement, R_up: Array | None = None) -> float:
    """Return the measured length on the mesh, in units of the mesh.

    Args:
        mesh: the mesh, in any unit.
        measurement: what was measured.
        R_up: (3, 3) that turns the mesh so that z is up, for 'height'; None = as it is.

    Raises:
        DegenerateError: the mesh has no size there.
    """
    from realsim.geometry.mesh import diameter

    v, kind = mesh.vertices, measurement.kind
    if kind == "longest":
        length = float(smallest_box(mesh)[0])
    elif kind == "diameter":
        length = diameter(mesh)
    elif kind == "height":
        heights = v @ (np.eye(3) if R_up is None else np.asarray(R_up, dtype=np.float64))[2]
        length = float(np.ptp(heights))
    elif kind == "between":
        if measurement.points is None:
            raise InputError("a length between two points needs the two points.")
        length = float(np.linalg.norm(np.subtract(*measurement.points)))
    else:
        length = float(mesh.extent[AXES[kind]])
    if not length > 0:
        raise DegenerateError(
            f"the mesh has no size where '{kind}' was measured ({MEANING[kind]}); its box is "
            f"{' x '.join(f'{e:.4g}' for e in mesh.extent)}. Measure something else."
        )
    return length


def smallest_box(mesh: Mesh) -> Array:
    """Return the sides (3,) of the smallest box around a mesh, longest first [its units].

    The box is turned as it likes, so that its sides do not depend on the mesh's axes.
    """
    import trimesh

    from realsim.geometry.mesh import hull_vertices

    corners = hull_vertices(mesh.vertices)
    # The box of a micrometre-sized or a kilometre-sized scan must not fall under an absolute
    # tolerance of the library: it is found at unit size.
    size = float(np.ptp(corners, axis=0).max())
    if not size > 0:
        return np.zeros(3)
    try:
        _, sides = trimesh.bounds.oriented_bounds((corners - corners.min(0)) / size)
    except Exception:  # a flat mesh has no hull; its box along the axes of most spread is the same
        centred = corners - corners.mean(0)
        axes = np.linalg.svd(centred, full_matrices=False)[2]
        return np.sort(np.ptp(centred @ axes.T, axis=0))[::-1].copy()
    return size * np.sort(np.asarray(sides, dtype=np.float64))[::-1]


def scale_of(
    mesh: Mesh, measurement: Measurement, R_up: Array | None = None, shape_m: float = 0.0
) -> LengthScale:
    """Return the scale that one measurement alone gives.

    scale = value / length. Both ends of the length lie on the mesh's surface, so a shape error
    adds to its sigma: sigma^2 = (sigma_value^2 + 2 shape^2) / length^2.

    Args:
        mesh: the mesh, in any unit.
        measurement: what was measured.
        R_up: (3, 3) that turns the mesh so that z is up, for 'height'; None = as it is.
        shape_m: RMS distance of the mesh's surface from the real one, where it is known [m].
    """
    length = length_of(mesh, measurement, R_up)
    sigma_m = float(np.sqrt(measurement.sigma_m**2 + 2 * shape_m**2))
    return LengthScale(
        measurement=measurement, length=length, scale=measurement.value_m / length,
        sigma=sigma_m / length,
    )  # fmt: skip


def weighted(scales: Sequence[float], sigmas: Sequence[float]) -> tuple[float, float]:
    """Return the mean by inverse variance and its sigma."""
    w = 1 / np.square(np.asarray(sigmas, dtype=np.float64))
    return float(np.sum(w * np.asarray(scales)) / np.sum(w)), float(1 / np.sqrt(np.sum(w)))


def scale_from(
    mesh: Mesh, measurements: Sequence[Measurement]
) -> tuple[float, float, tuple[LengthScale, ...]]:
    """Return scale and sigma [metres per unit] by measurements alone, and what each says.

    Raises:
        InputError: there is none, or they contradict each other; the odd one is named.
    """
    if not measurements:
        raise InputError(
            "a scale by measurement needs at least one length, such as longest=120.4mm."
        )
    each = tuple(scale_of(mesh, m) for m in measurements)
    fault = contradiction(each)
    if fault:
        raise InputError(fault)
    scale, sigma = weighted([e.scale for e in each], [e.sigma for e in each])
    return scale, sigma, each


def contradiction(each: Sequence[LengthScale]) -> str:
    """Return what is wrong among several measurements, '' when they agree with each other."""
    if _worst_pair(each) <= AGREE_Z:
        return ""
    found = "; ".join(f"{e.measurement.text} gives {e.scale:.6g} m per unit" for e in each)
    rests = [[e for e in each if e is not odd] for odd in each]
    alone = [k for k, rest in enumerate(rests) if _worst_pair(rest) <= AGREE_Z]
    if len(each) > 2 and len(alone) == 1:
        odd, rest = each[alone[0]], rests[alone[0]]
        mean, _ = weighted([e.scale for e in rest], [e.sigma for e in rest])
        guess = typo(odd.scale / mean)
        return (
            f"the measured lengths contradict each other: {found}. The odd one is "
            f"'{odd.measurement.text}': the others say {1e3 * mean * odd.length:.4g} mm there"
            f"{'' if not guess else f' ({guess})'}. Measure it again, or leave it out."
        )
    if len(each) > 2:
        return (
            f"the measured lengths contradict each other: {found}. No single one is to blame: "
            "measure them again."
        )
    guess = typo(each[0].scale / each[1].scale)
    return (
        f"the measured lengths contradict each other: {found}{'' if not guess else f' ({guess})'}. "
        "Which one is wrong cannot be told: measure again, or measure a third length."
    )


def _worst_pair(each: Sequence[LengthScale]) -> float:
    """Return the greatest z score between any two measurements; 0 for fewer than two."""
    s, sd = np.array([e.scale for e in each]), np.array([e.sigma for e in each])
    z = np.abs(s[:, None] - s[None]) / np.hypot(sd[:, None], sd[None])
    return float(z.max()) if len(each) > 1 else 0.0


TYPO_FACTORS: tuple[tuple[float, str], ...] = (
    (10.0, "10 times too long: were mm typed as cm?"),
    (0.1, "10 times too short: were cm typed as mm?"),
    (1000.0, "1000 times too long: were mm typed as m?"),
    (0.001, "1000 times too short: was m typed as mm?"),
    (100.0, "100 times too long: were cm typed as m?"),
    (0.01, "100 times too short: was m typed as cm?"),
    (25.4, "25.4 times too long: were mm typed as inch?"),
    (1 / 25.4, "25.4 times too short: were inches typed as mm?"),
    (2.54, "2.54 times too long: were cm typed as inch?"),
    (1 / 2.54, "2.54 times too short: were inches typed as cm?"),
)
"""measured / true length of the usual slips, and how they are named."""


def typo(ratio: float) -> str:
    """Return which slip of the unit a ratio measured / true looks like, '' for none."""
    for factor, text in TYPO_FACTORS:
        if abs(ratio / factor - 1) <= TYPO_TOLERANCE:
            return text
    return ""
