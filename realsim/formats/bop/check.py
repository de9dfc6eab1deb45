"""Whether the labels of a scene agree with each other, by the formulas of BOP's documentation.

docs/bop_datasets_format.md and scripts/calc_gt_info.py of bop_toolkit say what scene_gt_info.json
holds; here it is computed again from the masks and the depth, and the poses are held against the
masks by projecting the models' vertices. Nothing is rendered: what needs a rendered surface (which
pixel exactly belongs to the silhouette) is only bounded.

A pose held against masks and depth by the projected vertices of its model.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import Array, Array32, Int32, Mask
from realsim.errors import InputError
from realsim.formats.bop.labels import bbox_of
from realsim.formats.bop.layout import Document, SceneLayout
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject, LabelledScene
from realsim.geometry import se3
from realsim.geometry.camera import project, turning_radius
from realsim.geometry.mesh import hull_vertices
from realsim.records import CameraIntrinsics, Mesh, ObjectModel

GROWN_PX = 2
"""By which the projected hull is grown [px] before a mask is asked to lie in it: pixels belong to a
mask by their centres, and the edge of a lens-bent hull is bent between its corners."""
COVERED = 0.98
"""Share of a mask's pixels that must lie in the projected hull."""
FILLED = 0.8
"""Overlap (intersection over union) of the box of a whole mask and of the projected vertices, cut
at the image, from which the pose and the mask are of one thing."""
IN_FRONT_SHARE = 0.01
"""Share of the visible pixels that may measure nearer than the model's nearest point by more than
delta: BOP's visibility excludes them, counted images round depth."""
BEHIND_SHARE = 0.5
"""Share of the visible pixels with depth that may lie behind the model's farthest point: BOP calls
such pixels visible, but where most are, the object is not where it is said to be."""
SMALLEST_PX = 30
"""Masks of fewer pixels say little of a pose."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Silhouette:
    """Where a model is in an image, by its vertices."""

    box: Array | None
    """x0 y0 x1 y1 of all vertices, also beyond the image [px]; None = some are not in front."""
    is_inside: bool
    """Whether all vertices are inside the image."""
    hull: Mask | None
    """(H, W) the hull of the projected vertices, grown; None = some are not in front."""
    nearest_m: float
    """Least depth of a vertex [m]."""
    farthest_m: float
    intrinsics: CameraIntrinsics
    corners: Array
    """(V, 3) vertices in the camera [m]."""
    faces: Int32

    @property
    def drawn_box(self) -> Array | None:
        """The box where BOP's own tools cut it: they draw on a canvas of three by three images."""
        if self.box is None:
            return None
        low = -np.array([self.intrinsics.width, self.intrinsics.height])
        return np.clip(self.box, np.tile(low, 2), np.tile(-2 * low - 1, 2))


def silhouette(intrinsics: CameraIntrinsics, T_cam_obj: Array, mesh: Mesh) -> Silhouette:
    """Return where a mesh is in an image."""
    import cv2

    corners = se3.transform(T_cam_obj, hull_vertices(mesh.vertices))
    z = corners[:, 2]
    nearest, farthest = float(z.min()), float(z.max())

    nowhere = Silhouette(
        box=None, is_inside=False, hull=None, nearest_m=nearest, farthest_m=farthest,
        intrinsics=intrinsics, corners=se3.transform(T_cam_obj, mesh.vertices), faces=mesh.faces,
    )  # fmt: skip
    if nearest <= 0:
        return nowhere
    radius = np.linalg.norm(corners[:, :2] / z[:, None], axis=1)
    if float(radius.max()) >= turning_radius(intrinsics):
        return nowhere
    # Of the hull's corners only: a point inside a hull is projected inside the corners' hull.
    uv = project(intrinsics, corners)
    box = np.concatenate([uv.min(axis=0), uv.max(axis=0)])
    size = np.array([intrinsics.width, intrinsics.height])
    canvas = np.zeros((intrinsics.height, intrinsics.width), np.uint8)
    limit = 4.0 * float(size.max())
    outline = cv2.convexHull(np.clip(uv, -limit, limit).astype(np.float32))
    filled: Any = cv2.fillConvexPoly(canvas, np.rint(outline).astype(np.int32), 1)
    kernel = np.ones((2 * GROWN_PX + 1, 2 * GROWN_PX + 1), np.uint8)
    grown: Any = cv2.dilate(filled, kernel)
    inside = bool(np.all(box[:2] >= 0) and np.all(box[2:] <= size - 1))
    return replace(nowhere, box=box, is_inside=inside, hull=np.asarray(grown) > 0)


def pose_findings(
    shape: Silhouette,
    whole: Mask | None,
    visible: Mask | None,
    depth_m: Array32 | None,
    delta_m: float,
    sheet: "Sheet",
) -> None:
    """Compare a pose with masks and depth.

    Args:
        shape: the projected model.
        whole: (H, W) its silhouette.
        visible: (H, W) the visible part.
        depth_m: (H, W) measured depth [m].
        delta_m: BOP's tolerance of visibility [m].
        sheet: takes the comparisons.
    """
    mask = visible if whole is None else whole
    pixels = 0 if mask is None else int(np.count_nonzero(mask))
    if mask is not None and shape.hull is not None and pixels >= SMALLEST_PX:
        covered = float(np.count_nonzero(mask & shape.hull)) / pixels
        sheet.compare(
            "scene_gt",
            "pose and mask",
            f"at least {COVERED:.0%} of the mask within the projected model",
            f"{covered:.1%}",
            agree=covered >= COVERED,
        )
    if whole is not None and shape.box is not None and pixels >= SMALLEST_PX:
        overlap, off = _overlap(_visible_box(shape), whole)
        if overlap < FILLED and not shape.is_inside:  # what is cut off may be a hollow of the hull
            overlap, off = max((overlap, off), _overlap(_shown_box(shape), whole))
        sheet.compare(
            "scene_gt",
            "pose and box",
            f"an overlap of at least {FILLED:g} of the mask's and the projected model's box",
            f"{overlap:.2f}",
            agree=overlap >= FILLED or off <= GROWN_PX,  # thin ends may hit no pixel's centre
        )
    if visible is not None and depth_m is not None:
        _compare_depth(shape, depth_m[visible].astype(np.float64), delta_m, sheet)


def _compare_depth(shape: Silhouette, depth_m: Array, delta_m: float, sheet: "Sheet") -> None:
    count = len(depth_m)
    if count < SMALLEST_PX:
        return
    measured = depth_m[depth_m > 0]
    front = int(np.count_nonzero(measured < shape.nearest_m - delta_m))
    sheet.compare(
        "scene_gt",
        "depth in front",
        f"at most {IN_FRONT_SHARE:.0%} of the visible pixels nearer than the model by "
        f"{1e3 * delta_m:g} mm",
        f"{front / count:.1%}",
        agree=front <= IN_FRONT_SHARE * count,
    )
    if len(measured) >= SMALLEST_PX:
        behind = float(np.mean(measured > shape.farthest_m + delta_m))
        sheet.compare(
            "scene_gt",
            "depth behind",
            f"at most {BEHIND_SHARE:.0%} of the visible pixels beyond the model",
            f"{behind:.1%}",
            agree=behind <= BEHIND_SHARE,
        )


def _visible_box(shape: Silhouette) -> Array:
    """Return the box [px] of what the image shows of a model: its border may cut a corner off."""
    assert shape.box is not None
    if shape.is_inside or shape.hull is None or not shape.hull.any():
        return shape.box
    x, y, w, h = bbox_of(shape.hull)
    border = np.array(shape.hull.shape[::-1]) - 1
    low, high = np.array([x, y]), np.array([x + w, y + h])
    return np.concatenate([
        np.where(low > 0, low + GROWN_PX, low), np.where(high < border, high - GROWN_PX, high)
    ]).astype(np.float64)  # fmt: skip


def _shown_box(shape: Silhouette) -> Array:
    """Return the box [px] of a model's pixels, drawn face by face."""
    import cv2

    width, height = shape.intrinsics.width, shape.intrinsics.height
    drawn, limit = np.zeros((height, width), np.uint8), 4.0 * max(width, height)
    uv = np.clip(project(shape.intrinsics, shape.corners), -limit, limit)
    for triangle in np.rint(uv).astype(np.int32)[shape.faces]:
        cv2.fillConvexPoly(drawn, triangle, 1)
    if not drawn.any():
        return np.full(4, -1.0)
    x, y, w, h = bbox_of(drawn > 0)
    return np.array([x, y, x + w, y + h], dtype=np.float64)


def _overlap(box: Array, mask: Mask) -> tuple[float, float]:
    """Return how a box and that of a mask overlap, and the greatest distance of two sides [px]."""
    height, width = mask.shape
    x, y, w, h = bbox_of(mask)
    a = np.array([x, y, x + w, y + h], dtype=np.float64)
    limits = np.array([width - 1, height - 1], dtype=np.float64)
    b = np.concatenate([np.clip(box[:2], 0, limits), np.clip(box[2:], 0, limits)])
    size = np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0) + 1
    area = float(np.prod(a[2:] - a[:2] + 1) + np.prod(b[2:] - b[:2] + 1))
    inside = float(np.prod(size))
    return inside / (area - inside), float(np.abs(a - b).max())


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
