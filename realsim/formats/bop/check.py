"""Whether the labels of a scene agree with each other, by the formulas of BOP's documentation.

docs/bop_datasets_format.md and scripts/calc_gt_info.py of bop_toolkit say what scene_gt_info.json
holds; here it is computed again from the masks and the depth, and the poses are held against the
masks by projecting the models' vertices. Nothing is rendered: what needs a rendered surface (which
pixel exactly belongs to the silhouette) is only bounded.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import Array, Array32, Mask
from realsim.errors import InputError
from realsim.formats.bop.check_poses import SMALLEST_PX, Silhouette, pose_findings, silhouette
from realsim.formats.bop.labels import bbox_of
from realsim.formats.bop.layout import Document, SceneLayout
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject, LabelledScene
from realsim.records import ObjectModel

DELTA_M = 0.015
"""Tolerance of BOP's visibility [m]; 5 mm for ITODD and for BOP's rendered images."""
FRACTION_TOLERANCE = 1e-6
"""Greatest difference of visib_fract against px_count_visib / px_count_all: files may have few
digits."""
BOX_PX = 2
"""By which bbox_obj and the box of projected vertices may differ on each side [px]: a pixel belongs
to a silhouette by its centre, and renderers round either way."""


@dataclass(frozen=True, kw_only=True, slots=True)
class BopFinding:
    """One disagreement."""

    file: str
    """Which file says it, by its name in the scene."""
    image: int
    place: int
    """Place of the object in the image's list."""
    obj_id: int
    what: str
    """Key or quantity: 'bbox_visib', 'mask', 'pose' ..."""
    said: str
    found: str

    def __str__(self) -> str:
        """Return it as one line."""
        return (
            f"{self.file}, image {self.image}, object {self.place} (id {self.obj_id}): {self.what} "
            f"says {self.said}, found {self.found}"
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class BopCheck:
    """What the check of a scene found."""

    scene: str
    frames: int
    objects: int
    compared: Mapping[str, int] = field(default_factory=dict[str, int])
    """How often each quantity was compared: what was not there could not be."""
    findings: tuple[BopFinding, ...] = ()
    """Disagreements, in the order of the images."""

    @property
    def agrees(self) -> bool:
        """Whether nothing disagrees."""
        return not self.findings

    def counts(self) -> dict[str, int]:
        """Return how many disagreements there are of each quantity."""
        found: dict[str, int] = {}
        for f in self.findings:
            found[f.what] = found.get(f.what, 0) + 1
        return found


class Sheet:
    """Notes of one object while it is checked."""

    def __init__(self, layout: SceneLayout, image: int, place: int, obj_id: int) -> None:
        """Begin with an object; see `compare`."""
        self.layout, self.image, self.place, self.obj_id = layout, image, place, obj_id
        self.findings: list[BopFinding] = []
        self.compared: list[str] = []

    def compare(self, document: Document, what: str, said: Any, found: Any, *, agree: bool) -> None:
        """Note a comparison, and a finding where the two do not agree."""
        self.compared.append(what)
        if not agree:
            self.findings.append(
                BopFinding(
                    file=self.layout.document(document).name,
                    image=self.image,
                    place=self.place,
                    obj_id=self.obj_id,
                    what=what,
                    said=str(said),
                    found=str(found),
                )
            )


def check_bop_scene(scene: LabelledScene) -> BopCheck:
    """Return where the labels of a scene contradict each other.

    Compared are, as far as they are there: mask_visib with mask; bbox_visib, bbox_obj,
    px_count_visib, px_count_valid, px_count_all and visib_fract with masks and depth; bbox_obj and
    the masks with the projected model; measured depth with the model's nearest and farthest point.

    Raises:
        InputError: an image or a mask cannot be read.
    """
    models = scene.models()
    layout = SceneLayout(folder=Path(), camera=scene.camera)
    findings: list[BopFinding] = []
    compared: dict[str, int] = {}
    objects = 0
    for index in scene.indices:
        frame = scene.frame(index)
        depth_m = _depth(scene, frame)
        for k, o in enumerate(frame.objects):
            sheet = Sheet(layout, index, k, o.obj_id)
            _check_object(scene, frame, k, o, depth_m, models.get(o.obj_id), sheet)
            objects += 1
            findings += sheet.findings
            for what in sheet.compared:
                compared[what] = compared.get(what, 0) + 1
    return BopCheck(
        scene=scene.name,
        frames=len(scene.indices),
        objects=objects,
        compared=compared,
        findings=tuple(findings),
    )


def _depth(scene: LabelledScene, frame: LabelledFrame) -> Array32 | None:
    file = scene.depth_file(frame.index)
    if file is None or frame.depth_unit_m is None:
        return None
    depth_m = images.read_depth(file, frame.depth_unit_m)
    camera = frame.intrinsics
    if depth_m.shape != (camera.height, camera.width):
        raise InputError(
            f"{file} has {depth_m.shape[1]}x{depth_m.shape[0]} pixels, its image "
            f"{camera.width}x{camera.height}."
        )
    return depth_m


def _check_object(
    scene: LabelledScene,
    frame: LabelledFrame,
    k: int,
    o: LabelledObject,
    depth_m: Array32 | None,
    model: ObjectModel | None,
    sheet: Sheet,
) -> None:
    whole = scene.mask(frame.index, k, visible=False)
    visible = scene.mask(frame.index, k, visible=True)
    shape = None if model is None else silhouette(frame.intrinsics, o.T_cam_obj, model.mesh)
    if whole is not None and visible is not None:
        outside = int(np.count_nonzero(visible & ~whole))
        sheet.compare(
            "scene_gt", "mask_visib", "within mask", f"{outside} pixels outside", agree=not outside
        )
    if o.gt_info is not None:
        check_info(dict(o.gt_info), whole, visible, depth_m, shape, sheet)
    if shape is not None:
        pose_findings(shape, whole, visible, depth_m, DELTA_M, sheet)


def check_info(
    info: Mapping[str, Any],
    whole: Mask | None,
    visible: Mask | None,
    depth_m: Array32 | None,
    shape: Silhouette | None,
    sheet: Sheet,
) -> None:
    """Compare a row of scene_gt_info.json with what its definition gives."""

    def compare(what: str, found: Any, *, agree: bool | None = None) -> None:
        if what in info:
            same = info[what] == found if agree is None else agree
            sheet.compare("scene_gt_info", what, info[what], found, agree=same)

    if visible is not None:
        compare("px_count_visib", int(np.count_nonzero(visible)))
        compare("bbox_visib", list(bbox_of(visible)))
    if whole is not None and depth_m is not None:
        compare("px_count_valid", int(np.count_nonzero(depth_m[whole] > 0)))
    count_all, count_visible = info.get("px_count_all"), info.get("px_count_visib")
    inside = shape is not None and shape.is_inside
    if whole is not None and isinstance(count_all, int):
        pixels = int(np.count_nonzero(whole))
        agree = count_all == pixels if inside else count_all >= pixels
        compare("px_count_all", pixels if inside else f"at least {pixels}", agree=agree)
    if isinstance(count_all, int) and isinstance(count_visible, int):
        fraction = count_visible / count_all if count_all else 0.0
        said = info.get("visib_fract")
        agree = isinstance(said, (int, float)) and abs(said - fraction) <= FRACTION_TOLERANCE
        compare("visib_fract", fraction, agree=agree)
    if "bbox_obj" not in info:
        return
    if count_visible == 0:
        compare("bbox_obj", [-1, -1, -1, -1])
    elif inside and whole is not None:
        compare("bbox_obj", list(bbox_of(whole)))
    is_large = not isinstance(count_all, int) or count_all >= SMALLEST_PX
    if shape is not None and shape.box is not None and count_visible and is_large:
        offs = [_box_difference(info["bbox_obj"], b) for b in (shape.box, shape.drawn_box)]
        agree = any(off is not None and off <= BOX_PX for off in offs)
        x0, y0, x1, y1 = (float(v) for v in shape.box)
        found = [round(v, 1) for v in (x0, y0, x1 - x0, y1 - y0)]
        compare("bbox_obj", f"{found} of projected vertices", agree=agree)


def _box_difference(said: Any, box: Array | None) -> float | None:
    """Return the greatest difference of a side of x, y, w, h to x0, y0, x1, y1; None = no box."""
    try:
        x, y, w, h = (float(v) for v in said)
    except (TypeError, ValueError):
        return None
    return None if box is None else float(np.abs(np.array([x, y, x + w, y + h]) - box).max())
