"""The tree of frames in tf and tf_static, at any moment of a recording.

Moving edges are interpolated on the rigid motions between their two neighbours (a constant twist),
edge by edge and then composed: exact for a revolute joint at constant speed, where interpolating
the composed pose would cut corners.
"""

from array import array

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.formats.bags.joints import SPEED_WINDOW_NS, UR_JOINTS, between
from realsim.formats.bags.wire import NS_PER_S, TransformMessage
from realsim.geometry import se3
from realsim.interop import R_from_quaternion_xyzw

TOOL = "tool0"
"""ROS-Industrial's name of the bare flange with z out of it; `flange` has x out of it."""
NUMBERS = 7
LEAST_QUATERNION = 1e-9
"""A shorter quaternion has no direction: it was never set."""
MAX_DEPTH = 200
"""Edges up to the root; more is a loop."""
T_BASE_BASELINK = np.diag([-1.0, -1.0, 1.0, 1.0])
"""ROS's `base_link` in the controller's `base` of a UR: turned by 180 deg about z."""


class _Edge:
    """A child in its parent: constant, or readings over time."""

    def __init__(self, parent: str) -> None:
        self.parent = parent
        self.static: Array | None = None
        self.stamps = array("q")
        self.values = array("d")
        self.times_ns: Int64 = np.zeros(0, dtype=np.int64)
        self.Ts: Array = np.zeros((0, 4, 4))


def T_of_numbers(numbers: tuple[float, ...] | Array) -> Array:
    """Return (..., 4, 4) of x y z [m] and a quaternion x y z w (..., 7)."""
    values = np.asarray(numbers, dtype=np.float64)
    return se3.from_rt(R_from_quaternion_xyzw(values[..., 3:]), values[..., :3])


class TfTree:
    """Frames and how they lie to each other; grown by `add`, asked by `lookup`."""

    def __init__(self) -> None:
        """Start empty."""
        self._edges: dict[str, _Edge] = {}

    def add(self, message: TransformMessage, time_ns: int, static: bool) -> None:
        """Take over a transform; of a static one the last counts."""
        edge = self._edges.get(message.child)
        if edge is None or edge.parent != message.parent:
            edge = self._edges[message.child] = _Edge(message.parent)
        length = float(np.linalg.norm(message.numbers[3:]))
        if not (np.all(np.isfinite(message.numbers)) and length > LEAST_QUATERNION):
            return  # says nothing
        if static:
            edge.static = T_of_numbers(message.numbers)
        else:
            edge.stamps.append(time_ns)
            edge.values.extend(message.numbers)

    def finish(self) -> None:
        """Sort what was added; of readings with one time stamp the first counts."""
        for edge in self._edges.values():
            if len(edge.stamps):
                edge.times_ns, order = np.unique(
                    np.frombuffer(edge.stamps, np.int64), return_index=True
                )
                values = np.frombuffer(edge.values, np.float64).reshape(-1, NUMBERS)
                edge.Ts = T_of_numbers(values[order])

    @property
    def frames(self) -> list[str]:
        """All names, sorted."""
        return sorted(set(self._edges) | {e.parent for e in self._edges.values()})

    def named(self, ending: str) -> list[str]:
        """Return the frames with this name, alone or behind a prefix."""
        return [f for f in self.frames if f == ending or f.endswith(("_" + ending, "/" + ending))]

    def _path(self, frame: str) -> list[str]:
        """Return the frame and its ancestors up to the root."""
        path = [frame]
        while path[-1] in self._edges and len(path) < MAX_DEPTH:
            path.append(self._edges[path[-1]].parent)
        return path

    def chain(self, a: str, b: str) -> tuple[list[str], list[str]] | None:
        """Return the edges' children from b and from a up to their common ancestor, or None."""
        up_a, up_b = self._path(a), self._path(b)
        common = next((f for f in up_b if f in up_a), None)
        if common is None:
            return None
        return up_b[: up_b.index(common)], up_a[: up_a.index(common)]

    def times_ns(self, a: str, b: str) -> Int64:
        """Return all time stamps of the moving edges between two frames; empty if none moves."""
        chain = self.chain(a, b)
        edges = [self._edges[f] for f in (chain[0] + chain[1] if chain else [])]
        moving = [e.times_ns for e in edges if e.static is None]
        return np.unique(np.concatenate(moving)) if moving else np.zeros(0, dtype=np.int64)

    def lookup(self, a: str, b: str, time_ns: int, max_gap_s: float) -> Array | None:
        """Return T_a_b (4, 4) [m] at a moment; None if they are not joined or in a gap."""
        chain = self.chain(a, b)
        if chain is None:
            return None
        halves: list[Array] = []
        for children in chain:
            T = np.eye(4)
            for child in children:
                step = self._edge_at(child, time_ns, max_gap_s)
                if step is None:
                    return None
                T = step @ T
            halves.append(T)
        return se3.invert(halves[1]) @ halves[0]

    def speed(self, a: str, b: str, time_ns: int, max_gap_s: float) -> float:
        """Return how fast b moves in a: the greater of rad/s and m/s; NaN where not known."""
        ends = [
            self.lookup(a, b, time_ns + d, max_gap_s) for d in (-SPEED_WINDOW_NS, SPEED_WINDOW_NS)
        ]
        if ends[0] is None or ends[1] is None:
            return float("nan")
        twist = se3.log(se3.invert(ends[0]) @ ends[1]) * (NS_PER_S / (2 * SPEED_WINDOW_NS))
        return float(max(np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])))

    def _edge_at(self, child: str, time_ns: int, max_gap_s: float) -> Array | None:
        edge = self._edges[child]
        if edge.static is not None:
            return edge.static
        weight = between(edge.times_ns, time_ns, max_gap_s)
        if weight is None:
            return None
        i, j, s = weight
        if i == j:
            return edge.Ts[i]
        return edge.Ts[i] @ se3.exp(s * se3.log(se3.invert(edge.Ts[i]) @ edge.Ts[j]))


def arm_frames(
    tree: TfTree, base: str | None, ee: str | None, has_ur_joints: bool
) -> tuple[str, str, Array, list[str]] | None:
    """Return the frames of base and flange, T_base_frame (4, 4), and notes; None if none is there.

    Args:
        tree: finished.
        base: name given by a person, or None to look for `base`, then `base_link`.
        ee: name given by a person, or None to look for `tool0`.
        has_ur_joints: a UR's joints were recorded, so that `base_link` is known to be turned.

    Raises:
        InputError: a given name is not there or not joined, or several would do.
    """
    for name in (base, ee):
        if name is not None and name not in tree.frames:
            raise InputError(
                f"tf has no frame '{name}'; it has {', '.join(tree.frames) or 'none'}."
            )
    found: list[tuple[str, str]] = []
    for e in [ee] if ee else tree.named(TOOL):
        # Of the same arm only: `gripper_base` is joined to every tool0, too.
        prefix = e.removesuffix(TOOL) if e.endswith(TOOL) else ""
        bases = [base] if base else [prefix + "base", prefix + "base_link"]
        joined = [b for b in bases if tree.chain(b, e) is not None]
        found += [(b, e) for b in joined[:1]]
    if not found and (base or ee):
        raise InputError(
            f"tf does not join {base or 'base or base_link'} and {ee or TOOL}: give base_frame= "
            f"and ee_frame= of {', '.join(tree.frames)}."
        )
    if not found:
        return None
    if len(found) > 1:
        options = ", ".join(f"{b} -> {e}" for b, e in found)
        raise InputError(f"tf has several arms: {options}. Choose one (base_frame= and ee_frame=).")
    b, e = found[0]
    if not (b == "base_link" or b.endswith(("_base_link", "/base_link"))):
        return b, e, np.eye(4), []
    if has_ur_joints or tree.named(UR_JOINTS[-1].replace("joint", "link")):
        note = f"tf frame {b} was turned by 180 deg about z into the UR controller's base."
        return b, e, T_BASE_BASELINK, [note]
    note = f"tf frame {b} was taken as the robot's base as it is: the arm is not known to be a UR."
    return b, e, np.eye(4), [note]
