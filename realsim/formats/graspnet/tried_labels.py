"""Grasps that physics tried as GraspNet's labels, so that graspnetAPI's loadGrasp gives them back.

    grasp_label/000_labels.npz                          what held of an object, in all scenes
    collision_label/scene_0000/collision_labels.npz     False where it held in this very scene

A label is a point, one of 300 views, 12 turns and 4 depths, with its own turn, depth and opening.
Only the view has to be rounded: the nearest is 4.7 deg (median) to 8.8 deg (at most) from an
approach. So every grasp is a point of its own, `depth` before the place between the fingertips on
the view's axis: that place, the turn and the opening come back exactly. The number of the turn is
the nearest of 12, for programs that read numbers and not the turn itself.

A grasp that failed is what every candidate is that nobody tried: -1.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array, Mask
from realsim.formats.export_folder import STATE, ExportFolder
from realsim.formats.graspnet.grasp_group import DEPTH_M, MOST_FRICTION, grasp_group
from realsim.formats.graspnet.grasp_labels import (
    MOST_POINTS,
    GraspLabels,
    write_collision_labels,
    write_grasp_labels,
)
from realsim.formats.graspnet.gripper_frame import (
    ANGLES,
    DEPTHS_M,
    R_GRASP_GRASPNET,
    VIEWS,
    rotations,
    views,
)
from realsim.formats.grasps.scene_grasps import SceneGrasps, executed
from realsim.records import GraspSet

OBJECTS = "graspnet_objects.json"
"""Rows of the export: scene -> (object number, instance) in the order of its object list."""
UNTOLD = -1
"""Instance of a thing whose source has none."""
Order = Sequence[tuple[int, int | None]]


@dataclass(frozen=True, eq=False, slots=True)
class _Part:
    """What one thing in one scene adds to its object's labels."""

    scene: int
    instance: int
    labels: GraspLabels


def labels_of(grasps: GraspSet) -> tuple[GraspLabels, Array]:
    """Return the grasps that held as labels, and by how much their approach was turned (N,) [deg].

    Raises:
        InputError: a grasp has neither a width nor an opening.
    """
    group = grasp_group([grasps], {grasps.instance: np.eye(4)}, scores="tried")
    R, n = group.Ts_a_grasp[:, :3, :3] @ R_GRASP_GRASPNET, len(group)
    approach, closing = R[:, :, 0], R[:, :, 1]
    near = -approach @ views().T
    view = np.argmax(near, axis=1).reshape(n)
    axis = -views()[view]
    level = rotations(axis, np.zeros(n))
    along = np.einsum("na,nab->nb", closing, level)
    # Half a turn more is the same gripper.
    turn = np.arctan2(along[:, 2], along[:, 1]) % np.pi
    slot = np.rint(turn * ANGLES / np.pi).astype(np.int32) % ANGLES
    depth = DEPTHS_M.index(DEPTH_M)
    columns = (np.arange(n), view, slot, np.full(n, depth))
    tried = np.zeros(VIEWS, dtype=np.bool_)
    tried[view] = True
    labels = GraspLabels(
        points=group.Ts_a_grasp[:, :3, 3] - DEPTH_M * axis,
        index=np.stack(columns, axis=1).astype(np.int32),
        angles_rad=turn.astype(np.float32),
        depths_m=np.full(n, DEPTH_M, dtype=np.float32),
        openings_m=group.openings_m.astype(np.float32),
        friction=np.round(MOST_FRICTION - group.scores, 6).astype(np.float32),
        collision=np.zeros(n, dtype=np.bool_),
        view_tried=tried,
    )
    turned = np.degrees(np.arccos(np.clip(near[np.arange(n), view], -1.0, 1.0)))
    return labels, turned


def told_of(grasps: SceneGrasps) -> tuple[int, tuple[str, ...]]:
    """Return how many grasps of a scene become labels, and what that costs."""
    found = [labels_of(s) for s in grasps.sets]
    count, tried = sum(len(x) for x, _ in found), sum(int(executed(s).sum()) for s in grasps.sets)
    turned = np.concatenate([np.zeros(0), *(t for _, t in found)])
    if not count:
        return 0, (f"none of {tried} tried grasps held: the grasp labels are empty.",)
    return count, (
        f"{count} of {tried} tried grasps held and are labels, a point each; what failed is -1, as "
        "all that was not tried. GraspNet has 300 directions: approaches are turned by "
        f"{np.median(turned):.1f} deg (median), {turned.max():.1f} deg (at most); the place "
        "between the fingertips, the turn about the approach and the opening are exact (programs "
        f"that take the number of the turn are up to {90 / ANGLES:.1f} deg off). Friction is the "
        "least at which a sweep held, else at which the contacts close, else 1.0: p_hold has no "
        "place.",
    )


def write_tried_labels(
    folder: ExportFolder, scenes: Iterable[tuple[int, SceneGrasps | None]]
) -> tuple[str, ...]:
    """Write the labels of all objects and the collisions of all scenes; return what to tell.

    Nothing is written without grasps, and in a tree whose labels were copied from a source.

    Args:
        folder: the export; its scenes are written.
        scenes: number and grasps of each; of several cameras of one scene the first that has any.

    Raises:
        InputError: a grasp has neither a width nor an opening.
        StorageError: the disk is full.
    """
    orders: dict[int, Order] = {int(k): rows for k, rows in folder.rows(OBJECTS)}
    parts: dict[int, list[_Part]] = {n: [] for order in orders.values() for n, _ in order}
    copied = any(folder.has(_label_file(n)) and not folder.has(_piece(n)) for n in parts)
    seen: set[int] = set()
    for number, grasps in scenes:
        if grasps is None or number in seen or copied:
            continue
        seen.add(number)
        places = _places(orders[number])
        for s in grasps.sets:
            at = places.get((s.obj_id, s.instance), places.get((s.obj_id, None)))
            if at is not None:
                instance = orders[number][at][1]
                labels, _ = labels_of(s)
                part = _Part(number, UNTOLD if instance is None else instance, labels)
                parts[orders[number][at][0]].append(part)
    if not seen:
        return ()
    told: list[str] = []
    joined: dict[int, tuple[GraspLabels, list[_Part]]] = {}
    for number, many in parts.items():
        joined[number] = _joined(many)
        left = sum(len(p.labels) for p in many) - len(joined[number][0])
        if left:
            told.append(
                f"object {number:03d}: {left} grasps of the last scenes are left out; a label file "
                f"holds {MOST_POINTS}."
            )
    kept = folder.folder / STATE / "labels.npz"
    for number, (labels, _) in joined.items():
        write_grasp_labels(kept, labels)
        folder.write_piece(_piece(number), {_label_file(number): kept})
    for number, order in orders.items():
        rows = [
            (joined[n][0], ~_own(joined[n][1], number, UNTOLD if i is None else i))
            for n, i in order
        ]
        write_collision_labels(kept, rows)
        name = f"collision_label/scene_{number:04d}/collision_labels.npz"
        folder.write_piece(f"tried {name}", {name: kept})
    return tuple(told)


def _label_file(number: int) -> str:
    return f"grasp_label/{number:03d}_labels.npz"


def _piece(number: int) -> str:
    return f"tried {_label_file(number)}"


def _places(order: Order) -> Mapping[tuple[int, int | None], int]:
    """Return the place of each (object id, instance) in an object list."""
    return {(number + 1, instance): k for k, (number, instance) in enumerate(order)}


def _joined(parts: Sequence[_Part]) -> tuple[GraspLabels, list[_Part]]:
    """Return the labels of an object and the parts that found a place among them."""
    kept: list[_Part] = []
    room = MOST_POINTS
    for p in parts:
        rows = np.arange(min(room, len(p.labels)))
        shown = p.labels.rows(rows)
        kept.append(_Part(p.scene, p.instance, replace(shown, points=p.labels.points[rows])))
        room -= len(rows)
    some = [_blank(), *(p.labels for p in kept)]
    columns = ("points", "index", "angles_rad", "depths_m", "openings_m", "friction", "collision")
    joined = {name: np.concatenate([getattr(x, name) for x in some]) for name in columns}
    counts = [len(x.points) for x in some]
    joined["index"][:, 0] += np.repeat(np.cumsum([0, *counts[:-1]]), [len(x) for x in some])
    tried = np.any([x.view_tried for x in some], axis=0)
    return GraspLabels(**joined, view_tried=tried), kept


def _blank() -> GraspLabels:
    """Return labels of no point at all."""
    no_one, none = np.zeros(0, np.bool_), np.zeros(0, np.float32)
    return GraspLabels(
        points=np.zeros((0, 3)), index=np.zeros((0, 4), np.int32), angles_rad=none, depths_m=none,
        openings_m=none, friction=none, collision=no_one, view_tried=np.zeros(VIEWS, np.bool_),
    )  # fmt: skip


def _own(parts: Sequence[_Part], scene: int, instance: int) -> Mask:
    """Return which labels of an object (N,) are of this thing in this scene."""
    return np.concatenate(
        [np.zeros(0, np.bool_)]
        + [np.full(len(p.labels), (p.scene, p.instance) == (scene, instance)) for p in parts]
    )
