"""`realsim stats NEW --compare OLD`: what two releases of a data set differ in, scene by scene."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from realsim.app.console import Console
from realsim.app.export.request import ExportRequest
from realsim.app.export.sources import SourceScene, source_scenes
from realsim.arrays import Array
from realsim.formats.labelled_scene import LabelledScene
from realsim.geometry import se3
from realsim.records import GraspSet

MOVED_MM, MOVED_DEG = 1e-3, 1e-3
"""A pose that differs by less is the same: files round."""
SAME_GRASP_M, SAME_GRASP_DEG = 1e-4, 0.1
"""Grasps of one thing that differ by less are one grasp."""
CHANGED = 0.01
"""Labels of one grasp that differ by more have changed."""
Thing = tuple[int, int]
"""Object id, and instance or place among its like."""


@dataclass(kw_only=True, slots=True)
class SceneDiff:
    """What a scene differs in."""

    scene: str
    state: str = "kept"
    """'kept', 'added' or 'lost'."""
    frames: int = 0
    frames_added: int = 0
    frames_lost: int = 0
    objects_added: list[Thing] = field(default_factory=list[Thing])
    objects_lost: list[Thing] = field(default_factory=list[Thing])
    moved: dict[Thing, tuple[float, float]] = field(
        default_factory=dict[Thing, tuple[float, float]]
    )
    """Greatest motion over the frames [mm], [deg]."""
    grasps_added: int = 0
    grasps_lost: int = 0
    grasps_changed: int = 0
    grasps_kept: int = 0

    @property
    def is_same(self) -> bool:
        """Whether nothing differs."""
        counts = (self.frames_added, self.frames_lost, self.grasps_added, self.grasps_lost,
                  self.grasps_changed)  # fmt: skip
        things = (self.objects_added, self.objects_lost, self.moved)
        return self.state == "kept" and not any(counts) and not any(things)

    def row(self) -> dict[str, Any]:
        """Return plain JSON values."""
        moved = [
            {"obj_id": i, "instance": k, "mm": mm, "deg": deg}
            for (i, k), (mm, deg) in sorted(self.moved.items())
        ]
        names = ("scene", "state", "frames", "frames_added", "frames_lost", "grasps_added",
                 "grasps_lost", "grasps_changed", "grasps_kept")  # fmt: skip
        return {name: getattr(self, name) for name in names} | {
            "objects_added": [list(t) for t in self.objects_added],
            "objects_lost": [list(t) for t in self.objects_lost],
            "moved": moved,
        }


def compare_releases(
    new: Sequence[Path], old: Path, console: Console
) -> dict[str, list[dict[str, Any]]]:
    """Show what scenes, frames, objects, poses and grasps of two releases differ in, and return it.

    Args:
        new: sessions, folders of them, BOP or GraspNet data sets.
        old: the same, as it was.
        console: where the table goes.

    Raises:
        InputError: one of them cannot be read.
    """
    after, before = _by_name(tuple(new)), _by_name((old,))
    diffs: list[SceneDiff] = []
    for name in sorted(after.keys() | before.keys()):
        if name not in after or name not in before:
            diffs.append(SceneDiff(scene=name, state="added" if name in after else "lost"))
            continue
        with console.stage("compare", name):
            diffs.append(diff_scenes(name, before[name].open(), after[name].open()))
    console.table(
        f"{', '.join(p.name for p in new)} since {old.name}",
        ("scene", "state", "frames", "objects", "moved", "at most [mm]", "[deg]", "grasps"),
        [_shown(d) for d in diffs],
    )
    same = sum(d.is_same for d in diffs)
    console.say(f"{same} of {len(diffs)} scenes are the same.")
    return {"comparison": [d.row() for d in diffs]}


def _by_name(sources: tuple[Path, ...]) -> dict[str, SourceScene]:
    """Return scenes by number and camera; by their names where numbers do not tell them apart."""
    scenes = source_scenes(ExportRequest(sources=sources, target="bop"))
    numbers = [f"{s.number:06d} {s.camera}".strip() for s in scenes]
    names = numbers if len(set(numbers)) == len(numbers) else [s.name for s in scenes]
    return dict(zip(names, scenes, strict=True))


def diff_scenes(name: str, old: LabelledScene, new: LabelledScene) -> SceneDiff:
    """Return what one scene differs in: frames by number, things by id and instance."""
    shared = sorted(set(old.indices) & set(new.indices))
    found = SceneDiff(
        scene=name, frames=len(shared), frames_added=len(set(new.indices) - set(shared)),
        frames_lost=len(set(old.indices) - set(shared)),
    )  # fmt: skip
    before, after = set[Thing](), set[Thing]()
    for index in shared:
        Ts_old, Ts_new = _poses(old, index), _poses(new, index)
        before |= Ts_old.keys()
        after |= Ts_new.keys()
        for thing in Ts_old.keys() & Ts_new.keys():
            off = se3.invert(Ts_old[thing]) @ Ts_new[thing]
            mm, deg = 1e3 * float(np.linalg.norm(off[:3, 3])), float(np.degrees(se3.angle(off)))
            if mm > MOVED_MM or deg > MOVED_DEG:
                worst = found.moved.get(thing, (0.0, 0.0))
                found.moved[thing] = (max(mm, worst[0]), max(deg, worst[1]))
    found.objects_added, found.objects_lost = sorted(after - before), sorted(before - after)
    _grasps(found, old, new)
    return found


def _poses(scene: LabelledScene, index: int) -> dict[Thing, Array]:
    poses: dict[Thing, Array] = {}
    for o in scene.frame(index).objects:
        place = sum(i == o.obj_id for i, _ in poses)
        poses[o.obj_id, place if o.instance is None else o.instance] = o.T_cam_obj
    return poses


def _grasps(found: SceneDiff, old: LabelledScene, new: LabelledScene) -> None:
    sets = [
        {} if grasps is None else {(s.obj_id, s.instance): s for s in grasps.sets}
        for grasps in (old.grasps(), new.grasps())
    ]
    for thing in sets[0].keys() | sets[1].keys():
        before, after = sets[0].get(thing), sets[1].get(thing)
        a, b = (0 if s is None else len(s) for s in (before, after))
        pairs = [] if before is None or after is None else _same(before, after)
        found.grasps_lost += a - len(pairs)
        found.grasps_added += b - len(pairs)
        if before is not None and after is not None:
            labels = [(before.labels[i], after.labels[j]) for i, j in pairs]
            changed = sum(not np.isclose(x, y, rtol=0, atol=CHANGED, equal_nan=True)
                          for x, y in labels)  # fmt: skip
            found.grasps_changed += changed
            found.grasps_kept += len(pairs) - changed


def _same(before: GraspSet, after: GraspSet) -> list[tuple[int, int]]:
    """Return the rows of grasps that are in both sets, each once."""
    if not len(before) or not len(after):
        return []
    from scipy.spatial import KDTree

    tree = KDTree(after.Ts_obj_grasp[:, :3, 3])
    pairs: list[tuple[int, int]] = []
    taken: set[int] = set()
    for i, T in enumerate(before.Ts_obj_grasp):
        for j in sorted(tree.query_ball_point(T[:3, 3], SAME_GRASP_M)):
            turn = se3.angle(T[:3, :3].T @ after.Ts_obj_grasp[j, :3, :3])
            if j not in taken and np.degrees(turn) <= SAME_GRASP_DEG:
                taken.add(j)
                pairs.append((i, j))
                break
    return pairs


def _shown(d: SceneDiff) -> list[object]:
    def change(added: int, lost: int, kept: int | str = "") -> str:
        parts = [f"+{added}"] * bool(added) + [f"-{lost}"] * bool(lost)
        return " ".join([str(kept)] * (kept != "") + parts) or "-"

    mm = max((m for m, _ in d.moved.values()), default=0.0)
    deg = max((a for _, a in d.moved.values()), default=0.0)
    grasps = change(d.grasps_added, d.grasps_lost, d.grasps_kept)
    return [
        d.scene, d.state, change(d.frames_added, d.frames_lost, d.frames),
        change(len(d.objects_added), len(d.objects_lost)), len(d.moved), f"{mm:.3f}", f"{deg:.3f}",
        f"{grasps} changed {d.grasps_changed}" if d.grasps_changed else grasps,
    ]  # fmt: skip
