"""`realsim stats NEW --compare OLD`: what two releases of a data set differ in, scene by scene."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.app.annotate.current import is_annotated, what_is_stale
from realsim.app.console import Console
from realsim.app.export.sources import SourceScene, source_scenes
from realsim.app.export.target import ExportRequest
from realsim.app.stages import open_session
from realsim.app.stats import compare_files
from realsim.arrays import Array, Int64
from realsim.formats.bop.labelled import BopLabelledScene
from realsim.formats.graspnet.grasp_labels import read_grasp_labels
from realsim.formats.graspnet.labelled import OBJECT_LIST, GraspnetLabelledScene
from realsim.formats.labelled_scene import LabelledFrame, LabelledScene
from realsim.formats.session_scene import SessionScene
from realsim.geometry import se3
from realsim.records import GraspSet
from realsim.review.corrections import apart

MOVED_MM, MOVED_DEG = 1e-3, 1e-3
"""A pose that differs by less is the same: files round."""
SAME_GRASP_M, SAME_GRASP_DEG = 1e-4, 0.1
"""Grasps of one thing that differ by less are one grasp; widths that differ by less are one."""
CHANGED = 0.01
"""Scores and labels of one grasp that differ by more have changed."""
CHANGED_PX = 1e-3
"""Intrinsics that differ by more have changed."""
Thing = tuple[str, int]
"""Name of the model, or its id where a release has no names; instance, or place among its like."""


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
    labels_added: int = 0
    """Objects in single frames that have a pose now, of things that both releases know."""
    labels_lost: int = 0
    moved: dict[Thing, tuple[float, float]] = field(
        default_factory=dict[Thing, tuple[float, float]]
    )
    """Greatest motion over the frames [mm], [deg]."""
    cameras_changed: int = 0
    """Frames whose camera stands elsewhere or has other intrinsics."""
    images_changed: int = 0
    """Frames with another colour or depth image."""
    masks_changed: int = 0
    """Frames with another mask."""
    grasps_added: int = 0
    grasps_lost: int = 0
    grasps_changed: int = 0
    """Grasps with another label, score or width."""
    grasps_kept: int = 0
    files_changed: list[str] = field(default_factory=list[str])
    """Further files that differ: tables, models, maps, grasps."""

    @property
    def is_same(self) -> bool:
        """Whether nothing differs."""
        found = asdict(self)
        same = ("scene", "state", "frames", "grasps_kept")
        return self.state == "kept" and not any(v for k, v in found.items() if k not in same)

    def row(self) -> dict[str, Any]:
        """Return plain JSON values."""
        moved = [
            {"object": name, "instance": k, "mm": mm, "deg": deg}
            for (name, k), (mm, deg) in sorted(self.moved.items())
        ]
        return asdict(self) | {"moved": moved}


def compare_releases(new: Sequence[Path], old: Path, console: Console) -> dict[str, Any]:
    """Show what two releases differ in, from scenes to masks and grasps, and return it.

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
        console.warn(*filter(None, map(_stale_words, (after[name], before[name]))))
        with console.stage("compare", name):
            diffs.append(diff_scenes(name, before[name].open(), after[name].open()))
            places = (before[name].folder, after[name].folder)
            diffs[-1].files_changed += compare_files.other_files(*places)
            lists = [p.parent / OBJECT_LIST for p in places]
            if after[name].kind == "graspnet" and not compare_files.is_same_file(*lists):
                diffs[-1].files_changed.append(OBJECT_LIST)
            if before[name].kind == after[name].kind == "session":
                diffs[-1].files_changed += compare_files.other_models(places, [{}, {}])
    console.table(
        f"{', '.join(p.name for p in new)} since {old.name}",
        ("scene", "state", "frames", "objects", "moved", "at most [mm]", "[deg]", "labels",
         "grasps", "other cameras", "images", "masks", "files"),
        [_shown(d) for d in diffs],
    )  # fmt: skip
    if not after.keys() & before.keys():
        console.warn(
            f"no scene is in both: {', '.join(sorted(after)[:4])} beside "
            f"{', '.join(sorted(before)[:4])}. Scenes are matched by number and camera; give two "
            "releases of one data set."
        )
    roots = _roots(before), _roots(after)
    files = [f for a, b in zip(*roots, strict=False) for f in compare_files.other_in_roots(a, b)]
    if files:
        console.warn(f"{len(files)} files beside the scenes differ: {', '.join(files[:8])}"
                     f"{' ...' if len(files) > 8 else ''}.")  # fmt: skip
    same = sum(d.is_same for d in diffs)
    console.say(f"{same} of {len(diffs)} scenes are the same.")
    return {"comparison": [d.row() for d in diffs], "files": files}


def _roots(scenes: dict[str, SourceScene]) -> list[Path]:
    """Return the roots of data sets: BOP's and GraspNet's scenes share what is beside them."""
    above = {"bop": 1, "graspnet": 2}
    return list(dict.fromkeys(
        s.folder.resolve().parents[above[s.kind]] for s in scenes.values() if s.kind in above
    ))  # fmt: skip


def _by_name(sources: tuple[Path, ...]) -> dict[str, SourceScene]:
    """Return scenes by number and camera; by their names where numbers do not tell them apart."""
    scenes = source_scenes(ExportRequest(sources=sources, target="bop"))
    numbers = [f"{s.number:06d} {s.camera}".strip() for s in scenes]
    names = numbers if len(set(numbers)) == len(numbers) else [s.name for s in scenes]
    return dict(zip(names, scenes, strict=True))


def _stale_words(scene: SourceScene) -> str:
    """Return what is to be done where a session's labels are not those of its scene."""
    if scene.kind != "session":
        return ""
    store = open_session(scene.folder)
    why = what_is_stale(store) if is_annotated(store) else ""
    return why and (
        f"the labels of {scene.folder} are older than its scene ({why}), and it is they that are "
        f"compared. `realsim annotate {scene.folder}` computes them anew."
    )


def diff_scenes(name: str, old: LabelledScene, new: LabelledScene) -> SceneDiff:
    """Return what one scene differs in: frames by number, things by model and instance."""
    shared = sorted(set(old.indices) & set(new.indices))
    found = SceneDiff(
        scene=name, frames=len(shared), frames_added=len(set(new.indices) - set(shared)),
        frames_lost=len(set(old.indices) - set(shared)),
    )  # fmt: skip
    names = (_names(old), _names(new))
    if not all(names):
        names = ({}, {})
    frames = [(i, old.frame(i), new.frame(i)) for i in shared]
    rows_of_old = [_rows(a, names[0]) for _, a, _ in frames]
    rows_of_new = [_rows(b, names[1]) for _, _, b in frames]
    before, after = (set[Thing]().union(*rows) for rows in (rows_of_old, rows_of_new))
    called = _counterparts(before, after)
    before = {called.get(t, t) for t in before}
    for (index, a, b), rows, rows_new in zip(frames, rows_of_old, rows_of_new, strict=True):
        rows_old = {called.get(t, t): k for t, k in rows.items()}
        both = rows_old.keys() & rows_new.keys()
        found.labels_lost += len((rows_old.keys() & after) - both)
        found.labels_added += len((rows_new.keys() & before) - both)
        for thing in both:
            T_old, T_new = (
                f.objects[rows[thing]].T_cam_obj for f, rows in ((a, rows_old), (b, rows_new))
            )
            mm, deg = apart(T_old, T_new)
            if mm > MOVED_MM or deg > MOVED_DEG:
                worst = found.moved.get(thing, (0.0, 0.0))
                found.moved[thing] = (max(mm, worst[0]), max(deg, worst[1]))
        found.cameras_changed += _is_other_camera(a, b)
        found.images_changed += _is_other(old.colour_file(index), new.colour_file(index)) or (
            _is_other(old.depth_file(index), new.depth_file(index))
        )
        found.masks_changed += any(
            _is_other_mask(old, new, index, (rows_old[t], rows_new[t])) for t in both
        )
    found.objects_added, found.objects_lost = sorted(after - before), sorted(before - after)
    if isinstance(old, GraspnetLabelledScene) and isinstance(new, GraspnetLabelledScene):
        _label_files(found, old, new)
    else:
        tried = {called.get(t, t): s for t, s in _sets(old, names[0]).items()}
        _grasps(found, tried, _sets(new, names[1]))
    return found


def _counterparts(before: set[Thing], after: set[Thing]) -> dict[Thing, Thing]:
    """Return old thing -> new thing where only the instance differs, in the order of instances."""
    called: dict[Thing, Thing] = {}
    for name in {name for name, _ in before}:
        lost = sorted(t for t in before - after if t[0] == name)
        called |= zip(lost, sorted(t for t in after - before if t[0] == name), strict=False)
    return called


def _names(scene: LabelledScene) -> dict[int, str]:
    """Return the names of the models by id; {} where they do not tell models apart."""
    if isinstance(scene, SessionScene):
        return compare_files.names_in(scene.store.folder / "models")
    folder = scene.models_folder if isinstance(scene, BopLabelledScene) else None
    return {} if folder is None else compare_files.names_in(folder)


def _rows(frame: LabelledFrame, names: dict[int, str]) -> dict[Thing, int]:
    """Return the place of each thing in a frame's objects."""
    rows: dict[Thing, int] = {}
    like = defaultdict[str, int](int)
    for k, o in enumerate(frame.objects):
        name = names.get(o.obj_id, str(o.obj_id))
        rows[name, like[name] if o.instance is None else o.instance] = k
        like[name] += 1
    return rows


def _is_other_camera(old: LabelledFrame, new: LabelledFrame) -> bool:
    a, b = old.intrinsics, new.intrinsics
    if (a.width, a.height) != (b.width, b.height) or old.depth_unit_m != new.depth_unit_m:
        return True
    if not np.allclose(a.K, b.K, rtol=0, atol=CHANGED_PX) or not np.array_equal(
        a.distortion, b.distortion
    ):
        return True
    Ts = (old.T_world_cam, new.T_world_cam)
    if Ts[0] is None or Ts[1] is None:
        return Ts[0] is not Ts[1]
    mm, deg = apart(Ts[0], Ts[1])
    return mm > MOVED_MM or deg > MOVED_DEG


def _is_other(old: Path | None, new: Path | None) -> bool:
    """Return whether two images differ in a pixel, however they are packed."""
    if old is None or new is None:
        return old is not new
    if old.read_bytes() == new.read_bytes():
        return False
    return not np.array_equal(images.read_image(old), images.read_image(new))


def _is_other_mask(
    old: LabelledScene, new: LabelledScene, index: int, rows: tuple[int, int]
) -> bool:
    for visible in (True, False):
        a, b = (s.mask(index, k, visible=visible) for s, k in zip((old, new), rows, strict=True))
        if (a is None) != (b is None) or (
            a is not None and b is not None and not np.array_equal(a, b)
        ):
            return True
    return False


def _label_files(found: SceneDiff, old: GraspnetLabelledScene, new: GraspnetLabelledScene) -> None:
    """Compare the labels of GraspNet's format: grasps by point, view, angle and depth."""
    roots = [s.ref.folder.parents[2] for s in (old, new)]
    for number in sorted({*old.object_numbers, *new.object_numbers}):
        files = [r / f"grasp_label/{number:03d}_labels.npz" for r in roots]
        if not any(f.is_file() for f in files):
            continue
        a, b = (_label_rows(f) for f in files)
        _, i, j = np.intersect1d(a[0], b[0], assume_unique=True, return_indices=True)
        changed = int(np.any(a[1][i] != b[1][j], axis=1).sum())
        found.grasps_lost += len(a[0]) - len(i)
        found.grasps_added += len(b[0]) - len(j)
        found.grasps_changed += changed
        found.grasps_kept += len(i) - changed
    name = f"collision_label/scene_{old.number:04d}"
    found.files_changed += [
        f"{name}/{f}" for f in compare_files.other_files(*(r / name for r in roots))
    ]


def _label_rows(file: Path) -> tuple[Int64, Array]:
    """Return the candidates of a label file: numbers (N,), and what is said of them (N, 8)."""
    if not file.is_file():
        return np.zeros(0, dtype=np.int64), np.zeros((0, 8))
    labels = read_grasp_labels(file, friction_at_most=2.0, with_collision=True)
    said = (labels.openings_m, labels.friction, labels.collision, labels.angles_rad,
            labels.depths_m)  # fmt: skip
    points = labels.points[labels.index[:, 0]]
    return labels.numbers, np.column_stack([*said, points]).astype(np.float64)


def _sets(scene: LabelledScene, names: dict[int, str]) -> dict[Thing, GraspSet]:
    grasps = scene.grasps()
    sets = () if grasps is None else grasps.sets
    return {(names.get(s.obj_id, str(s.obj_id)), s.instance): s for s in sets}


def _grasps(found: SceneDiff, old: dict[Thing, GraspSet], new: dict[Thing, GraspSet]) -> None:
    for thing in old.keys() | new.keys():
        before, after = old.get(thing), new.get(thing)
        a, b = (0 if s is None else len(s) for s in (before, after))
        pairs = [] if before is None or after is None else list(_same(before, after))
        found.grasps_lost += a - len(pairs)
        found.grasps_added += b - len(pairs)
        if before is not None and after is not None and pairs:
            i, j = np.array(pairs).T
            changed = ~np.isclose(
                before.widths_m[i], after.widths_m[j], rtol=0, atol=SAME_GRASP_M, equal_nan=True
            )
            for name in ("labels", "scores", "base_scores", "reachable"):
                x, y = (np.asarray(getattr(s, name), np.float64) for s in (before, after))
                changed |= ~np.isclose(x[i], y[j], rtol=0, atol=CHANGED, equal_nan=True)
            found.grasps_changed += int(changed.sum())
            found.grasps_kept += int((~changed).sum())


def _same(before: GraspSet, after: GraspSet) -> Iterator[tuple[int, int]]:
    """Return the rows of grasps that are in both sets, each once."""
    if not len(before) or not len(after):
        return
    from scipy.spatial import KDTree

    tree = KDTree(after.Ts_obj_grasp[:, :3, 3])
    taken: set[int] = set()
    for i, T in enumerate(before.Ts_obj_grasp):
        for j in sorted(tree.query_ball_point(T[:3, 3], SAME_GRASP_M)):
            turn = se3.angle(T[:3, :3].T @ after.Ts_obj_grasp[j, :3, :3])
            if j not in taken and np.degrees(turn) <= SAME_GRASP_DEG:
                taken.add(j)
                yield (i, j)
                break


def _shown(d: SceneDiff) -> list[object]:
    if d.state != "kept":
        return [d.scene, d.state, *[""] * 11]

    def change(added: int, lost: int, kept: int | str = "") -> str:
        parts = [f"+{added}"] * bool(added) + [f"-{lost}"] * bool(lost)
        return " ".join([str(kept)] * (kept != "") + parts) or "-"

    mm = max((m for m, _ in d.moved.values()), default=0.0)
    deg = max((a for _, a in d.moved.values()), default=0.0)
    grasps = change(d.grasps_added, d.grasps_lost, d.grasps_kept)
    return [
        d.scene, d.state, change(d.frames_added, d.frames_lost, d.frames),
        change(len(d.objects_added), len(d.objects_lost)), len(d.moved), f"{mm:.3f}", f"{deg:.3f}",
        change(d.labels_added, d.labels_lost),
        f"{grasps} changed {d.grasps_changed}" if d.grasps_changed else grasps,
        d.cameras_changed, d.images_changed, d.masks_changed, len(d.files_changed),
    ]  # fmt: skip
