"""Does a GraspNet tree mean what the format says? Direction, order and units against the content.

The objects of a scene stand still, so that wrong camera poses or quaternions show as objects that
wander from image to image; labels and depth show where the objects are, and how far.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Array32, UInt16
from realsim.errors import InputError, UnitError
from realsim.formats.evidence import depth_ratio
from realsim.formats.graspnet.image_objects import ImageObject
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.records import CameraIntrinsics

ON_TABLE_M = 0.25
"""Origins of things on a table are not farther from its plane than this."""
STANDS_M = 0.010
"""Objects that wander less stand still."""
WANDERS_M = 0.030
"""More than annotations err: the poses of the tree contradict each other."""
STANDS_RAD = float(np.radians(5.0))
BETTER = 4.0
"""Another reading must explain the images so much better to be named as the cause."""
NAMED_M = 0.005
"""A single annotation that is farther from the others is named."""
DEPTH_FACTOR = 1.5
"""Measured depth over the annotated distance; units differ by 10."""
FEWEST_PX = 50
"""An object with fewer labelled pixels tells nothing."""
FEWEST_OBJECTS = 2
MARGIN = 0.5
"""An origin may lie so much of its labelled box's size beside that box."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PosedImage:
    """An image that is looked at."""

    index: int
    T_0_cam: Array
    """(4, 4) as camera_poses.npy has it [m]."""
    objects: tuple[ImageObject, ...]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SeenImage:
    """An image whose pixels are looked at."""

    index: int
    intrinsics: CameraIntrinsics
    objects: tuple[ImageObject, ...]
    label: UInt16 | None
    """(H, W)."""
    depth_m: Array32 | None
    """(H, W) [m]."""


def check_camera_poses(images: Sequence[PosedImage], where: str) -> list[str]:
    """Check by the objects, which stand still, that camera_poses.npy maps camera i to camera 0.

    Raises:
        InputError: the inverse explains the images much better, or nothing does.
    """
    stated = _wandering(images, [i.T_0_cam for i in images])
    if not stated:
        return []
    inverse = _wandering(images, [se3.invert(i.T_0_cam) for i in images])
    apart, other = float(np.median([*stated.values()])), float(np.median([*inverse.values()]))
    figures = (
        f"over {len(images)} images the objects wander by {1e3 * apart:.1f} mm (median) if it maps "
        f"camera i to camera 0, which is the format's direction, and by {1e3 * other:.1f} mm if it "
        "maps camera 0 to camera i"
    )
    if apart > STANDS_M and other * BETTER < apart:
        raise InputError(f"{where} seems to hold inverted poses: {figures}. Invert the matrices.")
    if apart > WANDERS_M:
        raise InputError(
            f"{where} contradicts the annotations: {figures}. They are of different recordings, or "
            "the objects were moved."
        )
    if apart > STANDS_M:
        return [f"camera poses and annotations disagree: {figures}."]
    return _worst_annotation(images)


def check_table(images: Sequence[PosedImage], T_table_0: Array, where: str) -> None:
    """Check by where cameras and objects are that cam0_wrt_table.npy maps camera 0 to the table.

    Cameras look at a table from above, and things lie on it.

    Raises:
        InputError: a camera would be below the table, or all things far from it, and the inverse
            makes both right.
    """
    stated, inverse = _above_table(images, T_table_0), _above_table(images, se3.invert(T_table_0))
    if not _is_scene(*stated) and _is_scene(*inverse):
        raise InputError(
            f"{where} seems to be inverted: as the pose of camera 0 in the table's frame the "
            f"cameras are {1e3 * stated[0]:.0f} mm above the table and the objects "
            f"{1e3 * stated[1]:.0f} mm (medians); inverted, {1e3 * inverse[0]:.0f} and "
            f"{1e3 * inverse[1]:.0f} mm. Invert the matrix."
        )


def _above_table(images: Sequence[PosedImage], T_table_0: Array) -> tuple[float, float]:
    """Return the median height [m] of cameras and of objects above the table; NaN of none."""
    cameras = [float((T_table_0 @ i.T_0_cam)[2, 3]) for i in images]
    objects = [
        float((T_table_0 @ i.T_0_cam @ o.T_cam_obj)[2, 3]) for i in images for o in i.objects
    ]
    return (
        float(np.median(cameras)) if cameras else float("nan"),
        float(np.median(objects)) if objects else float("nan"),
    )


def _is_scene(camera_m: float, object_m: float) -> bool:
    return camera_m > object_m and abs(object_m) < ON_TABLE_M


def _wandering(images: Sequence[PosedImage], Ts: Sequence[Array]) -> dict[int, float]:
    """Return by object number the median distance [m] from its median place over the images."""
    found: dict[int, float] = {}
    for number, rows in _places(images, Ts).items():
        if len(rows) > 1:
            points = np.array([point for _, point in rows])
            off = np.linalg.norm(points - np.median(points, axis=0), axis=1)
            found[number] = float(np.median(off))
    return found


def _places(
    images: Sequence[PosedImage], Ts: Sequence[Array]
) -> dict[int, list[tuple[int, Array]]]:
    """Return by object number where the images put it: (number of the image, place [m])."""
    places: dict[int, list[tuple[int, Array]]] = {}
    for image, T in zip(images, Ts, strict=True):
        for o in single_objects(image.objects):
            places.setdefault(o.number, []).append((image.index, (T @ o.T_cam_obj)[:3, 3]))
    return places


def single_objects(objects: Sequence[ImageObject]) -> list[ImageObject]:
    """Return the objects whose number is there once."""
    numbers = [o.number for o in objects]
    return [o for o in objects if numbers.count(o.number) == 1]


def _worst_annotation(images: Sequence[PosedImage]) -> list[str]:
    worst, text = NAMED_M, ""
    for number, rows in _places(images, [i.T_0_cam for i in images]).items():
        centre = np.median([p for _, p in rows], axis=0)
        for index, point in rows:
            off = float(np.linalg.norm(point - centre))
            if off > worst:
                worst = off
                text = f"object {number:03d} lies {1e3 * off:.1f} mm elsewhere by image {index}"
    return [f"{text} than by the others that were compared."] if text else []


def check_quaternions(images: Sequence[PosedImage], where: str) -> None:
    """Check by the objects, which do not turn, that quaternions are w x y z.

    Raises:
        InputError: x y z w explains the images much better.
    """
    turns: dict[str, list[float]] = {"wxyz": [], "xyzw": []}
    first: dict[int, tuple[Array, Array]] = {}
    for image in images:
        R = image.T_0_cam[:3, :3]
        for o in single_objects(image.objects):
            if o.xyzw_R_cam_obj is None:
                continue
            both = (R @ o.T_cam_obj[:3, :3], R @ o.xyzw_R_cam_obj)
            if o.number not in first:
                first[o.number] = both
                continue
            for name, before, after in zip(turns, first[o.number], both, strict=True):
                turns[name].append(float(se3.angle(before.T @ after)))
    if not turns["wxyz"]:
        return
    stated, other = float(np.median(turns["wxyz"])), float(np.median(turns["xyzw"]))
    if stated > STANDS_RAD and other * BETTER < stated:
        raise InputError(
            f"{where}: the quaternions seem to be x y z w: over {len(images)} images the objects "
            f"turn by {np.degrees(stated):.1f} deg (median) if they are w x y z, which is the "
            f"format's order, and by {np.degrees(other):.1f} deg if they are x y z w."
        )


def check_depth(images: Sequence[SeenImage], unit_m: float, where: str) -> None:
    """Check by the objects' distance that the depth images have their unit.

    Raises:
        UnitError: they do not.
    """
    ratios = [r for image in images for r in _depth_ratios(image)]
    if not ratios:
        return
    ratio = float(np.median(ratios))
    if not 1 / DEPTH_FACTOR < ratio < DEPTH_FACTOR:
        raise UnitError(
            f"{where}: the measured depth of {len(ratios)} objects is {ratio:.3g} times their "
            f"annotated distance with {1 / unit_m:g} counts per metre (factor_depth; GraspNet's is "
            f"1000); about {ratio / unit_m:.3g} counts per metre would fit. Correct factor_depth, "
            "or the depth images, or the positions (metres)."
        )


def _depth_ratios(image: SeenImage) -> list[float]:
    """Return measured depth / annotated distance of the objects of an image."""
    if image.depth_m is None:
        return []
    found = [
        depth_ratio(
            image.depth_m, None if image.label is None else image.label == o.number + 1,
            image.intrinsics, o.T_cam_obj, window_px=5, least=(FEWEST_PX, FEWEST_PX),
        )
        for o in single_objects(image.objects)
    ]  # fmt: skip
    return [ratio for ratio in found if ratio is not None]


def check_labels(images: Sequence[SeenImage], where: str) -> list[str]:
    """Check that label images show the objects where the poses put them, and count the rest.

    Raises:
        InputError: most objects are elsewhere.
    """
    hits = {1: 0, 0: 0}
    looked, unknown, hidden = 0, 0, 0
    strange: set[int] = set()
    for image in [i for i in images if i.label is not None]:
        assert image.label is not None
        values = np.flatnonzero(np.bincount(image.label.ravel()))
        known = {o.number + 1 for o in image.objects}
        others = {int(v) for v in values if v > 0} - known
        strange |= others
        unknown += bool(others)
        hidden += len(known - set(values.tolist()))
        for o in single_objects(image.objects):
            own = np.count_nonzero(image.label == o.number + 1) >= FEWEST_PX
            # Labels that forgot the + 1 have values that belong to nobody.
            forgot = o.number in others and np.count_nonzero(image.label == o.number) >= FEWEST_PX
            if not (own or forgot):
                continue
            looked += 1
            for shift in hits:
                hits[shift] += _is_near(image, o, o.number + shift)
    if looked >= FEWEST_OBJECTS and 2 * hits[1] < looked:
        instead = f", {hits[0]} if a value is the number itself" if hits[0] > hits[1] else ""
        raise InputError(
            f"{where}: of {looked} labelled objects only {hits[1]} are where their poses and the "
            f"camera matrix put them (value = object number + 1{instead}). Labels, annotations and "
            "camK belong to different images or sizes."
        )
    count = sum(i.label is not None for i in images)
    notes: list[str] = []
    if strange:
        notes.append(
            f"the labels of {unknown} of {count} images looked at have values without an object: "
            f"{', '.join(map(str, sorted(strange)[:10]))}; they are nobody's mask."
        )
    if hidden:
        notes.append(
            f"{hidden} annotated objects have no labelled pixel in {count} images looked at: they "
            "are hidden, or out of the image."
        )
    return notes


def _is_near(image: SeenImage, o: ImageObject, value: int) -> bool:
    """Return whether an object's origin is drawn in or beside the pixels of a label."""
    assert image.label is not None
    if value == 0:  # the background
        return False
    rows, columns = np.nonzero(image.label == value)
    uv = project(image.intrinsics, o.T_cam_obj[:3, 3])
    if not len(rows) or not np.all(np.isfinite(uv)):
        return False
    low = np.array([columns.min(), rows.min()])
    high = np.array([columns.max(), rows.max()])
    # What hides a part of an object makes its box smaller, and origins are not always centres.
    margin = MARGIN * (high - low + 1)
    return bool(np.all(uv >= low - margin) and np.all(uv <= high + margin))
