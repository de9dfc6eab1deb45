"""Grasps as they are drawn: which of them, in what colours, and the gripper's few triangles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Array32, Mask, Rgb, Rows
from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.geometry.colors import light_of_bytes
from realsim.records import STAGES, GraspSet
from realsim.rendering.overlay import evenly_ranked
from realsim.review.content import quick_png
from realsim.store.session_store import depth_path

if TYPE_CHECKING:
    from realsim.review.content.content import SceneContent

BARS = 3
"""Sides of a bar: the fewest that can be seen from everywhere."""
FINGER_M = 0.035
"""Length of the drawn fingers [m]; about that of a two-finger gripper's pads."""
STEM_M = 0.03
"""Length of the bar behind the fingers that shows the approach [m]."""
BAR_M = 0.002
"""Thickness of palm and stem [m]: a pixel or two where a whole table is in view."""
FINGER_SHARE = 0.04
"""Thickness of a finger, as a share of the width: it grows with it, since one mesh is scaled."""
LEAST_WIDTH_M = 0.002
"""A gripper that is drawn narrower cannot be clicked [m]."""
HIDDEN_M = 0.01
"""A contact is seen if no measured surface is nearer to the camera by this much [m]: noise and
the error of a pose are less, the thickness of an object is more."""

FAILED, HELD = "any failure", "none: it held"
"""What `GraspFilter.failure` asks for beside words of the failures themselves."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GraspFilter:
    """Which grasps are drawn: those that pass everything."""

    stage: int = 0
    """Least number of stages passed, 0 to 4; untried grasps passed none."""
    min_label: float = 0.0
    """Least p_hold, of sets without it least score, in [0, 1]; what is not known counts as 0."""
    reachable_only: bool = False
    """Only those the arm reaches without a collision."""
    visible: Mapping[int, frozenset[int]] | None = None
    """Only these rows of each instance, such as `visible_grasps`; None = all."""
    instance: int | None = None
    """Only those of this object; None = of all."""
    failure: str = ""
    """Only those whose failure says this, such as 'lift' or 'collides'; '' = all. `FAILED` = those
    that failed anywhere, `HELD` = those of which no failure is told."""
    show: bool = True
    """Whether any are drawn."""

    def __post_init__(self) -> None:
        """Check the number of stages and the label."""
        if not 0 <= self.stage <= len(STAGES):
            raise InputError(f"a grasp passes 0 to {len(STAGES)} stages, not {self.stage}.")
        if not 0.0 <= self.min_label <= 1.0:
            raise InputError(f"a least p_hold or score of {self.min_label}; they are from 0 to 1.")


def passing(grasps: GraspSet, chosen: GraspFilter) -> Rows:
    """Return the rows of a set that pass a filter, in ascending order."""
    other = chosen.instance is not None and chosen.instance != grasps.instance
    if other or not chosen.show:
        return np.zeros(0, np.int64)
    # A tenth of a stage is room for how base scores were rounded in files.
    keep = np.nan_to_num(grasps.base_scores, nan=0.0) >= (chosen.stage - 0.1) / len(STAGES)
    keep &= np.nan_to_num(grasps.labels, nan=0.0) >= chosen.min_label
    if chosen.reachable_only:
        keep &= grasps.reachable
    if chosen.visible is not None:
        seen = np.zeros(len(grasps), np.bool_)
        rows = [r for r in chosen.visible.get(grasps.instance, ()) if 0 <= r < len(grasps)]
        seen[rows] = True
        keep &= seen
    keep &= _says(grasps, chosen.failure)
    return np.flatnonzero(keep)


def chosen_grasps(
    sets: Sequence[GraspSet], chosen: GraspFilter, most: int
) -> list[tuple[GraspSet, Rows]]:
    """Return the grasps that are drawn: those that pass, or an even choice of them.

    If more than `most` pass, every k-th in the order of the labels of its object is drawn, so that
    good and bad ones and the objects stay in proportion.
    """
    found = [(g, passing(g, chosen)) for g in sets]
    total = sum(len(rows) for _, rows in found)
    if total > most:
        share = most / total
        found = [(g, np.sort(evenly_ranked(g, int(share * len(r)), r))) for g, r in found]
    return [(g, rows) for g, rows in found if len(rows)]


def _says(grasps: GraspSet, failure: str) -> Mask:
    """Return (N,) which grasps failed by what `GraspFilter.failure` asks for."""
    if failure in (FAILED, HELD):
        return np.array([bool(f) == (failure == FAILED) for f in grasps.failures], np.bool_)
    word = failure.casefold()
    return np.array([word in f.casefold() for f in grasps.failures], np.bool_)


def failure_choices(sets: Sequence[GraspSet]) -> dict[str, str]:
    """Return what failures can be filtered by, with its count -> `GraspFilter.failure`."""
    words = (FAILED, HELD, *STAGES, "collides", "inverse kinematics", "joint limits", "not tested")
    counts = {w: sum(int(_says(g, w).sum()) for g in sets) for w in words}
    return {f"{w} ({n})": w for w, n in counts.items() if n}


def visible_grasps(
    content: "SceneContent", view: int, Ts_world_obj: Mapping[int, Array] | None = None
) -> dict[int, frozenset[int]]:
    """Return the rows of every instance of which a view sees at least one contact.

    A contact is seen where it falls into the picture and no measured surface is nearer than it by
    `HIDDEN_M`.

    Args:
        content: the scene.
        view: number of the view.
        Ts_world_obj: instance -> pose (4, 4) where objects were moved; others stand as registered.

    Raises:
        InputError: the view has no camera pose, or no depth.
    """
    store = content.store
    T_world_cam = content.pose_of(view)
    if not store.has_depth(view):
        raise InputError(f"view {view} has no depth, so what it sees of a grasp is not known.")
    depth_m = quick_png.read_depth(store.path(depth_path(view)), store.session.depth_unit_m)
    found: dict[int, frozenset[int]] = {}
    for grasps in content.grasp_sets:
        T_world_obj = content.scene.object(grasps.instance).T_world_obj
        if Ts_world_obj is not None:
            T_world_obj = Ts_world_obj.get(grasps.instance, T_world_obj)
        T_cam_grasp = se3.invert(T_world_cam) @ T_world_obj @ grasps.Ts_obj_pads
        half = 0.5 * grasps.widths_m[:, None] * T_cam_grasp[:, :3, 1]
        contacts = np.stack([T_cam_grasp[:, :3, 3] - half, T_cam_grasp[:, :3, 3] + half], 1)
        seen = _unhidden(contacts.reshape(-1, 3), depth_m, content).reshape(-1, 2).any(1)
        found[grasps.instance] = frozenset(np.flatnonzero(seen).tolist())
    return found


def _unhidden(points: Array, depth_m: Array32, content: "SceneContent") -> Mask:
    """Return (N,) which points (N, 3) in the camera [m] no measured surface hides."""
    i = content.intrinsics
    seen = np.zeros(len(points), np.bool_)
    before = np.flatnonzero(points[:, 2] > 0)
    uv = camera.project(i, points[before])
    inside = np.all((uv > -0.5) & (uv < [i.width - 0.5, i.height - 0.5]), axis=1)
    at = np.rint(uv[inside]).astype(int)
    z = depth_m[at[:, 1], at[:, 0]]
    rows = before[inside]
    seen[rows] = (z == 0) | (points[rows, 2] <= z + HIDDEN_M)
    return seen


def linear_rgb(rgb: Rgb) -> Rgb:
    """Return sRGB colours as linear light, 8 bit: what the browser takes instances' colours for."""
    return np.rint(255.0 * light_of_bytes(rgb)).astype(np.uint8)


def gripper_mesh() -> tuple[Array32, NDArray[np.uint32]]:
    """Return the gripper of width 1 as vertices (24, 3) in its grasp frame and faces (24, 3).

    Two fingers, palm and stem, each a bar of three sides. Scaled along y by a grasp's width it is
    that grasp: the fingers' inner sides are then so far apart.
    """
    back, share = -FINGER_M, FINGER_SHARE
    bars = [
        _bar([0.0, -0.5 - share / 2, back], [0, 0, 1], FINGER_M, [BAR_M, share]),
        _bar([0.0, 0.5 + share / 2, back], [0, 0, 1], FINGER_M, [BAR_M, share]),
        _bar([0.0, -0.5 - share, back], [0, 1, 0], 1 + 2 * share, [BAR_M, BAR_M]),
        _bar([0.0, 0.0, back - STEM_M], [0, 0, 1], STEM_M, [BAR_M, share]),
    ]
    vertices = np.concatenate(bars)
    k = np.arange(BARS)
    after = (k + 1) % BARS
    sides = np.concatenate(
        [np.stack([k, after, BARS + k], 1), np.stack([after, BARS + after, BARS + k], 1)]
    )
    faces = np.concatenate([sides + 2 * BARS * b for b in range(len(bars))])
    return vertices.astype(np.float32), faces.astype(np.uint32)


def _bar(start: list[float], along: list[int], length: float, across: list[float]) -> Array:
    """Return the corners (6, 3) of a bar of three sides along y or z: first those of its start.

    Args:
        start: middle of its first end (3,).
        along: unit vector (3,).
        length: of the bar.
        across: extent along x and along the third axis.
    """
    axis = np.array(along, dtype=np.float64)
    third = np.array([0.0, axis[2], axis[1]])
    angles = 2 * np.pi * np.arange(BARS) / BARS + np.pi / 6
    # The triangle is stretched to the full extent: the flat side of a finger is its inner one.
    x, y = np.cos(angles), np.sin(angles)
    x, y = x / np.ptp(x), (y - (y.max() + y.min()) / 2) / np.ptp(y)
    ring = np.outer(x, [across[0], 0, 0]) + np.outer(y, across[1] * third)
    begin = np.array(start) + ring
    return np.concatenate([begin, begin + length * axis])


def gripper_scales(widths_m: ArrayLike) -> Array32:
    """Return the scales (N, 3) of the gripper of width 1 for grasps of widths (N,) [m]."""
    widths = np.maximum(np.asarray(widths_m, dtype=np.float64), LEAST_WIDTH_M)
    return np.stack([np.ones_like(widths), widths, np.ones_like(widths)], -1).astype(np.float32)
