"""How two reports differ: figure by figure, and object by object."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from realsim.app.report.figures import CATALOGUE, Figure, shown
from realsim.app.report.sources import Source
from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.symmetric_poses import nearest_symmetry
from realsim.records import ObjectModel

SIGMAS = 2.0
"""A difference of more than so many sigmas is more than noise: 1 in 20 is so by chance."""
Outcome = Literal["better", "worse", "same", "other", "unknown"]
OUTCOMES: dict[Outcome, str] = {
    "better": "better",
    "worse": "worse",
    "same": "the same, or within noise",
    "other": "other, neither better nor worse",
    "unknown": "differs; its noise is not known",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Difference:
    """One figure of two sessions."""

    name: str
    first: Figure | None
    """None = that session has not got it."""
    second: Figure | None

    @property
    def value(self) -> float | None:
        """Return second less first; None where one is missing."""
        if self.first is None or self.second is None:
            return None
        return self.second.value - self.first.value

    @property
    def sigma(self) -> float | None:
        """Return 1 sigma of the difference; None = not known."""
        if self.first is None or self.second is None:
            return None
        if self.first.sigma is None or self.second.sigma is None:
            return None
        return math.hypot(self.first.sigma, self.second.sigma)

    @property
    def outcome(self) -> Outcome | None:
        """Return what the difference means; None where there is none.

        Where sigma is not known a difference may be noise: it is neither better nor worse.
        """
        value, sigma = self.value, self.sigma
        if value is None:
            return None
        if value == 0 or (sigma is not None and abs(value) <= SIGMAS * sigma):
            return "same"
        return "unknown" if sigma is None else self.tends or "other"

    @property
    def tends(self) -> Literal["better", "worse", ""]:
        """Return which way it goes, where that says something."""
        better = CATALOGUE[self.name].better
        if self.value is None or self.value == 0 or better == "none":
            return ""
        return "better" if (self.value > 0) == (better == "higher") else "worse"

    @property
    def shown(self) -> str:
        """Return the difference with its sigma."""
        if self.value is None:
            return "-"
        text = shown(self.value, self.sigma)
        return text if self.value <= 0 else f"+{text}"


def differences(first: Source, second: Source) -> list[Difference]:
    """Return every figure that one of two sessions has, in the order of the catalogue."""
    return [
        Difference(name=n, first=first.figures.get(n), second=second.figures.get(n))
        for n in CATALOGUE
        if n in first.figures or n in second.figures
    ]


# --- objects ----------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectDifference:
    """One object of two sessions, or of one of them."""

    name: str
    first: Mapping[str, Any] | None
    second: Mapping[str, Any] | None
    note: str = ""
    """What cannot be compared, and why."""
    mssd_mm: float | None = None
    """Largest distance of a point of its surface, least over its symmetries; None = no mesh."""
    shift_mm: float | None = None
    """Distance of its middle (of its origin, where there is no mesh)."""
    turn_deg: float | None = None
    """Turn, least over the symmetries where they are known."""

    @property
    def sigma_mm(self) -> float | None:
        """Return 1 sigma of the shift along the worst axis; None = not known."""
        sides = [None if s is None else s.get("sigma_mm") for s in (self.first, self.second)]
        known = [float(s) for s in sides if s is not None]
        return math.hypot(*known) if len(known) == 2 else None

    @property
    def is_moved(self) -> bool | None:
        """Return whether it stands elsewhere by more than noise; None = not known."""
        if self.shift_mm is None or self.sigma_mm is None:
            return None
        return self.shift_mm > SIGMAS * self.sigma_mm


def object_differences(first: Source, second: Source) -> list[ObjectDifference]:
    """Return the objects of two sessions, matched.

    Objects of the same instance number and model belong together; of the rest those whose model
    stands once in each. Others are named and not compared.
    """
    a = {int(o["instance"]): o for o in first.objects}
    b = {int(o["instance"]): o for o in second.objects}
    pairs = {i: i for i in a if i in b and a[i]["obj_id"] == b[i]["obj_id"]}
    rest_a, rest_b = [i for i in a if i not in pairs], [i for i in b if i not in pairs.values()]
    for i in rest_a:
        model = a[i]["obj_id"]
        mine = [k for k in rest_a if a[k]["obj_id"] == model]
        theirs = [k for k in rest_b if b[k]["obj_id"] == model]
        if len(mine) == len(theirs) == 1:
            pairs[i] = theirs[0]
    # Ordered by both numbers: which session is named first must not change the order.
    found = [_pair(a[i], b[k], first, second) for i, k in sorted(pairs.items(), key=sorted)]
    alone = [
        ObjectDifference(name=_name(a[i]), first=a[i], second=None, note=f"only in {first.letter}")
        for i in a.keys() - pairs.keys()
    ] + [
        ObjectDifference(name=_name(b[i]), first=None, second=b[i], note=f"only in {second.letter}")
        for i in b.keys() - pairs.values()
    ]
    return found + sorted(alone, key=lambda d: (d.name, d.note))


def _name(row: Mapping[str, Any]) -> str:
    return f"{row['instance']} {row['name']}"


def _pair(
    a: Mapping[str, Any], b: Mapping[str, Any], first: Source, second: Source
) -> ObjectDifference:
    obj_id = int(a["obj_id"])
    one, two = first.models.get(obj_id), second.models.get(obj_id)
    model, note = one or two, ""
    if one is not None and two is not None and not _same_mesh(one, two):
        model, note = None, f"model {obj_id} has another mesh in each: not compared"
        return ObjectDifference(name=_name(a), first=a, second=b, note=note)
    if model is None:
        note = "no mesh: distance of the origins, symmetries not known"
    mssd, shift, turn = pose_difference(
        np.asarray(a["T_world_obj"]), np.asarray(b["T_world_obj"]), model
    )
    if a["instance"] != b["instance"]:
        note = f"instance {a['instance']} there, {b['instance']} here" + ("; " + note) * bool(note)
    return ObjectDifference(
        name=_name(a), first=a, second=b, note=note, mssd_mm=mssd, shift_mm=shift, turn_deg=turn
    )


def _same_mesh(one: ObjectModel, two: ObjectModel) -> bool:
    return np.array_equal(one.mesh.vertices, two.mesh.vertices) and np.array_equal(
        one.mesh.faces, two.mesh.faces
    )


def pose_difference(
    T_a: Array, T_b: Array, model: ObjectModel | None
) -> tuple[float | None, float, float]:
    """Return MSSD [mm], shift of the middle [mm] and turn [deg] between two poses of an object.

    Which is named first does not matter: the error of b against a by one of the symmetries is that
    of a against b by its inverse, and here the two are always taken in the same order.

    Args:
        T_a: (4, 4) pose in the first session [m].
        T_b: (4, 4) pose in the second one, in the same world [m].
        model: with mesh and symmetries; None = neither is known.
    """
    if T_b.tobytes() < T_a.tobytes():
        T_a, T_b = T_b, T_a
    if np.array_equal(T_a, T_b):
        return (None if model is None else 0.0), 0.0, 0.0
    if model is None:
        delta = se3.invert(T_a) @ T_b
        shift = float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]))
        return None, 1e3 * shift, float(np.degrees(se3.angle(delta)))
    near = nearest_symmetry(T_a, T_b, model.mesh.vertices, model.symmetries, model.symmetry_axes)
    T_near = T_a @ near.S
    middle = model.mesh.bounds.mean(0)
    shift = np.linalg.norm(se3.transform(T_near, middle) - se3.transform(T_b, middle))
    turn = np.degrees(se3.angle(se3.invert(T_near) @ T_b))
    return 1e3 * near.distance_m, 1e3 * float(shift), float(turn)
