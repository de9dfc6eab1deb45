"""What a data set said of the frames of a session that was imported from it: kept, never changed.

    SESSION/imported/scene.json         where it came from, numbers of its images, table
    SESSION/imported/scene_gt.json, scene_gt_info.json, scene_camera.json     BOP's form, original
                                        numbers of images and original rows where it was BOP
    SESSION/imported/mask/, mask_visib/ 000017_000000.png

`realsim register` may start from these poses, `realsim annotate` writes its own labels elsewhere.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.bop.labels import gt_row, mask_path
from realsim.formats.labelled_scene import LabelledObject, LabelledScene
from realsim.records import bop_units as units
from realsim.records.checked_arrays import rigid
from realsim.store import SessionStore
from realsim.store.atomic import json_bytes

FOLDER = "imported"
SCENE = f"{FOLDER}/scene.json"
GT, INFO, CAMERA = (
    f"{FOLDER}/{n}" for n in ("scene_gt.json", "scene_gt_info.json", "scene_camera.json")
)
INSTANCE = "instance_in_scene"
"""Key, ours, of a row of scene_gt.json: which of several alike."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ImportedLabels:
    """The labels that came with a session."""

    folder: Path
    """SESSION/imported."""
    name: str
    """Name of the scene in its data set."""
    number: int
    split: str
    camera: str
    number_of_view: Mapping[int, int]
    """The session's view -> the data set's number of the image."""
    T_world_table: Array | None
    notes: tuple[str, ...]
    """What was said of them when they were imported."""
    rows: Mapping[str, Any]
    infos: Mapping[str, Any]
    cameras: Mapping[str, Any]

    def objects(self, index: int) -> tuple[LabelledObject, ...]:
        """Return the objects of an image, by its number in the data set."""
        infos: list[Any] = list(self.infos.get(str(index), ()))
        found: list[LabelledObject] = []
        for k, row in enumerate(self.rows.get(str(index), ())):
            name = f"object {k} of image {index} of {self.folder / 'scene_gt.json'}"
            T = units.object_in_camera(
                row["cam_R_m2c"], row["cam_t_m2c"], name, may_touch=bool(row.get(units.AT_THE_LENS))
            )
            info = infos[k] if k < len(infos) else None
            original = {key: value for key, value in row.items() if key != INSTANCE}
            found.append(
                LabelledObject(
                    obj_id=int(row["obj_id"]), T_cam_obj=T, instance=row.get(INSTANCE),
                    visible_fraction=None if not info else info.get("visib_fract"),
                    gt_info=info or None, entry=original,
                )
            )  # fmt: skip
        return tuple(found)

    def camera_entry(self, index: int) -> Mapping[str, Any] | None:
        """Return the data set's row of an image's camera."""
        return self.cameras.get(str(index))

    def mask_file(self, index: int, k: int, *, visible: bool) -> Path:
        """Return where the mask of an image's k-th object is, if there is one."""
        return self.folder / mask_path(index, k, visible=visible)


def load_imported(store: SessionStore) -> ImportedLabels | None:
    """Return the labels that came with a session; None = there are none.

    Raises:
        InputError: they are damaged.
    """
    if not store.has(SCENE):
        return None
    head = store.read_json(SCENE)
    try:
        table = head["T_world_table"]
        return ImportedLabels(
            folder=store.folder / FOLDER,
            name=str(head["name"]),
            number=int(head["number"]),
            split=str(head["split"]),
            camera=str(head["camera"]),
            number_of_view={int(k): int(v) for k, v in head["number_of_view"].items()},
            T_world_table=None if table is None else rigid(np.asarray(table), "T_world_table"),
            notes=tuple(str(note) for note in head.get("notes", ())),
            rows=dict(store.read_json(GT)),
            infos=dict(store.read_json(INFO)),
            cameras=dict(store.read_json(CAMERA)),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{SCENE} of {store.folder} is damaged ({error!r}); import the data set again."
        ) from error


def save_imported(
    store: SessionStore,
    scene: LabelledScene,
    number_of_view: Mapping[int, int],
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write what a data set says of a session's views; scene.json, which makes it count, last.

    Args:
        store: the session; its views are there.
        scene: the data set's scene.
        number_of_view: the session's view -> the number of the image in the scene.
        progress: called with (done, total) views.
    """
    rows: dict[str, Any] = {}
    infos: dict[str, Any] = {}
    cameras: dict[str, Any] = {}
    for done, (_, index) in enumerate(sorted(number_of_view.items()), start=1):
        frame = scene.frame(index)
        rows[str(index)] = [row_of(o) for o in frame.objects]
        if any(o.gt_info for o in frame.objects):
            infos[str(index)] = [dict(o.gt_info or {}) for o in frame.objects]
        cameras[str(index)] = dict(
            frame.entry
            or units.camera_entry(frame.intrinsics, frame.depth_unit_m or 1e-3, frame.T_world_cam)
        )
        store.write_derived(_mask_files(scene, index, len(frame.objects)))
        if progress is not None:
            progress(done, len(number_of_view))
    for path, value in ((GT, rows), (INFO, infos), (CAMERA, cameras)):
        store.write_bytes(path, json_bytes(value, indent=None))
    table = scene.T_world_table
    head = {
        "name": scene.name,
        "number": scene.number,
        "split": scene.split,
        "camera": scene.camera,
        "number_of_view": {str(k): v for k, v in sorted(number_of_view.items())},
        "T_world_table": None if table is None else table.tolist(),
        "notes": list(scene.notes),
    }
    store.write_json(SCENE, head)


def row_of(labelled: LabelledObject) -> dict[str, Any]:
    """Return an object as a row of scene_gt.json: the source's own where that is BOP's."""
    entry = dict(labelled.entry or {})
    if not {"cam_R_m2c", "cam_t_m2c", "obj_id"} <= entry.keys():
        entry = gt_row(labelled.obj_id, labelled.T_cam_obj)
    return entry if labelled.instance is None else {**entry, INSTANCE: labelled.instance}


def _mask_files(scene: LabelledScene, index: int, count: int) -> dict[str, bytes]:
    files: dict[str, bytes] = {}
    for k in range(count):
        for visible in (False, True):
            mask = scene.mask(index, k, visible=visible)
            if mask is not None:
                files[f"{FOLDER}/{mask_path(index, k, visible=visible)}"] = images.png_bytes(mask)
    return files
