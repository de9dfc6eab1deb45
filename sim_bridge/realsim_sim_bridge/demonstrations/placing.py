"""Where things are to be put: goals composed from a scene, in words, and checked by geometry.

Left, right, in front and behind are the robot's: it looks from its base over the middle of the
scene. A thing is left of another if its middle is, within 45 degrees of straight left and not
farther than `FARTHEST_M`; it is on the free area if nothing is near. It stands there as it stood at
first, turned by nothing, so that every goal is a pose that stands.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, KDTree

from realsim.arrays import Array
from realsim.geometry import se3

FREE = "free"
TURNS = {"behind": 0.0, "left": 90.0, "front": 180.0, "right": 270.0}
"""Angle of each relation from where the robot looks, about the table's z [deg]."""
PHRASES = {
    "left": (
        "put the {a} left of the {b}, seen from the robot",
        "place the {a} to the left of the {b} as the robot sees it",
        "move the {a} to the robot's left of the {b}",
    ),
    "right": (
        "put the {a} right of the {b}, seen from the robot",
        "place the {a} to the right of the {b} as the robot sees it",
        "move the {a} to the robot's right of the {b}",
    ),
    "front": (
        "put the {a} in front of the {b}, seen from the robot",
        "place the {a} between the robot and the {b}",
        "move the {a} to the robot's side of the {b}",
    ),
    "behind": (
        "put the {a} behind the {b}, seen from the robot",
        "place the {a} beyond the {b} as the robot sees it",
        "move the {a} to the far side of the {b}",
    ),
    FREE: (
        "put the {a} on the free area of the table",
        "place the {a} where the table is free",
        "set the {a} down away from everything else",
    ),
}
GAPS_M = (0.04, 0.07, 0.10)
"""Distances from the other thing that are tried [m]."""
APART_M, FREE_M = 0.02, 0.06
"""Least distance of a goal from everything that stands there, and on the free area [m]."""
FREE_RIM_M, FARTHEST_M = 0.04, 0.30
"""Distance that still counts as free, and at which things are no longer beside each other [m]."""
REACH_M, GRID_M = 0.30, 0.05
"""Half the edge of the area in which free places are looked for, and their spacing [m]."""
RIM_M = 0.002
"""Spacing of points on the rim of a thing seen from above [m]."""
LOWEST_M, UPRIGHT_DEG = 0.003, 20.0
"""A thing stands if it is so near to the table, and leans no more than this against before."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PlaceGoal:
    """Where one thing is to be put."""

    relation: str
    """One of `PHRASES`."""
    reference: int | None
    """Instance that the relation is to; None = on the free area."""
    shift_m: tuple[float, float]
    """From where it stands, table frame [m]."""
    language: str


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Standing:
    """The things on a table, seen from above."""

    corners: Mapping[int, Array]
    """(V, 3) of each thing where it stands, by instance, table frame [m]."""
    names: Mapping[int, str]
    """As they are spoken, by instance."""
    ahead: Array
    """(2,) where the robot looks, of length 1."""

    def direction(self, relation: str) -> Array:
        """Return a relation's direction (2,) on the table, of length 1."""
        turned = se3.exp_so3([0.0, 0.0, np.radians(TURNS[relation])])[:2, :2]
        return np.asarray(turned @ self.ahead, np.float64)


def goals_of(standing: Standing, instance: int, phrase: int) -> Iterator[PlaceGoal]:
    """Yield the goals that leave an object apart from the others, in a fixed order.

    What is so already is no goal: a failed attempt would meet it.

    Args:
        standing: the things.
        instance: what is put somewhere.
        phrase: number of the phrasing; they are taken in turn.
    """
    own, others = standing.corners[instance], _others(standing, instance)
    for other, corners in others.items():
        if standing.names[other] == standing.names[instance]:
            continue  # words would not tell which
        for relation in TURNS:
            if related(standing, relation, other, own):
                continue
            towards = standing.direction(relation)
            edge = float(np.max(corners[:, :2] @ towards) - np.min(own[:, :2] @ towards))
            beside = middle(corners) - middle(own)
            for gap in GAPS_M:
                shift = (edge + gap) * towards
                shift = shift + (beside - (beside @ towards) * towards)
                moved = own + np.append(shift, 0.0)
                if distance(moved, others.values()) >= APART_M and related(
                    standing, relation, other, moved
                ):
                    yield _goal(standing, relation, instance, other, shift, phrase)
                    break
    if distance(own, others.values()) >= FREE_RIM_M:
        return
    free = _freest(own, others, middle(np.concatenate(list(standing.corners.values()))))
    if free is not None:
        yield _goal(standing, FREE, instance, None, free, phrase)


def related(standing: Standing, relation: str, reference: int, corners: Array) -> bool:
    """Return whether a thing (V, 3) is where a relation to another says."""
    apart = middle(corners) - middle(standing.corners[reference])
    along = float(apart @ standing.direction(relation))
    aside = float(np.sqrt(max(float(apart @ apart) - along * along, 0.0)))
    return along > 0.0 and along >= aside and along <= FARTHEST_M


def unmet(goal: PlaceGoal, standing: Standing, instance: int, T_before: Array, T: Array) -> str:
    """Return in words what a goal lacks when an object has come to T_table_obj (4, 4); '' = met.

    Args:
        goal: the goal.
        standing: the things as they stood at first; all others stand there still.
        instance: the object.
        T_before: (4, 4) where it stood at first [m].
        T: (4, 4) where it is now [m].
    """
    name = standing.names[instance]
    corners = se3.transform(T @ se3.invert(T_before), standing.corners[instance])
    lean = float(np.degrees(np.arccos(np.clip((T @ se3.invert(T_before))[2, 2], -1.0, 1.0))))
    if lean > UPRIGHT_DEG:
        return f"the {name} does not stand as it did: it leans {lean:.0f} deg"
    if float(corners[:, 2].min()) > LOWEST_M:
        return f"the {name} does not stand on the table"
    if goal.reference is None:
        near = distance(corners, _others(standing, instance).values())
        return "" if near >= FREE_RIM_M else f"the {name} is {1e3 * near:.0f} mm from another thing"
    if related(standing, goal.relation, goal.reference, corners):
        return ""
    where = {"front": "in front of", "behind": "behind"}.get(
        goal.relation, f"{goal.relation} of"
    )  # fmt: skip
    return f"the {name} is not {where} the {standing.names[goal.reference]}"


def middle(corners: Array) -> Array:
    """Return the middle (2,) of a thing's box seen from above [m]."""
    return (corners[:, :2].min(axis=0) + corners[:, :2].max(axis=0)) / 2.0


def distance(corners: Array, others: Iterable[Array]) -> float:
    """Return the least distance of a thing from others, seen from above as convex [m].

    0 where they overlap; inf where there is no other.
    """
    least, own = np.inf, _rim(corners)
    for other in others:
        rim = _rim(other)
        if _inside(own, rim) or _inside(rim, own):
            return 0.0
        least = min(least, float(KDTree(rim).query(own)[0].min()))
    return least


def _rim(corners: Array) -> Array:
    """Return points (P, 2) on the rim of a thing seen from above."""
    hull = corners[:, :2][ConvexHull(corners[:, :2]).vertices]
    after = np.roll(hull, -1, axis=0)
    out: list[Array] = []
    for a, b in zip(hull, after, strict=True):
        n = max(1, int(np.ceil(np.linalg.norm(b - a) / RIM_M)))
        out.append(a + np.linspace(0.0, 1.0, n, endpoint=False)[:, None] * (b - a))
    return np.concatenate(out)


def _inside(points: Array, rim: Array) -> bool:
    """Return whether any of the points (P, 2) is inside a convex rim, counter-clockwise."""
    edges = np.roll(rim, -1, axis=0) - rim
    gap = points[:, None] - rim
    return bool(np.any(np.all(edges[:, 0] * gap[..., 1] - edges[:, 1] * gap[..., 0] > 0, axis=1)))


def _others(standing: Standing, instance: int) -> dict[int, Array]:
    return {i: corners for i, corners in standing.corners.items() if i != instance}


def _freest(own: Array, others: Mapping[int, Array], about: Array) -> Array | None:
    """Return the shift (2,) to the nearest place with `FREE_M` about it; None = there is none."""
    side = np.arange(-REACH_M, REACH_M + 1e-9, GRID_M)
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2) + about
    order = np.argsort(np.linalg.norm(places - about, axis=1), kind="stable")
    for place in places[order]:
        shift = place - middle(own)
        if np.linalg.norm(shift) < GRID_M:
            continue  # it is there already
        if distance(own + np.append(shift, 0.0), others.values()) >= FREE_M:
            return shift
    return None


def _goal(
    standing: Standing, relation: str, instance: int, other: int | None, shift: Array, phrase: int
) -> PlaceGoal:
    """Return a goal with its words."""
    words = PHRASES[relation][phrase % len(PHRASES[relation])]
    named = {"a": standing.names[instance], "b": "" if other is None else standing.names[other]}
    return PlaceGoal(
        relation=relation,
        reference=other,
        shift_m=(float(shift[0]), float(shift[1])),
        language=words.format(**named),
    )
