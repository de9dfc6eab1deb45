"""Whether poses, camera and depth of labelled images belong together, by the models' surfaces.

The models are put where the labels say, and what was measured at their pixels is held against
them. Without masks and boxes nothing else tells a transposed rotation or a wrong focal length.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from realsim.arrays import Array, Array32
from realsim.errors import InputError
from realsim.formats.bop.evidence import transposed
from realsim.formats.bop.scene import GT_FILE
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.geometry.mesh import sample_surface
from realsim.records import CameraIntrinsics, ObjectModel

CELLS = 64
"""Pixels that are looked at are so many across an image: the nearest point of a surface in each."""
SAMPLES = 6000
"""Points of a surface: several for each of its cells, or those of its far side would show."""
AGREES_M, AGREES_SHARE = 0.008, 0.005
"""Depth agrees within this [m] and this share of itself: labels are some millimetres off."""
NEAREST_M, BESIDE = 0.01, 100.0
"""Points nearer than this [m], or so many image widths beside the image, are nowhere."""
SURE = 0.7
"""Labels that fit so well are not doubted. Right ones of YCB-V, whose depth is noisy, fit by 0.26
to 0.72, those of other real data sets by 0.73 to 0.96."""
ALONE = 0.4
"""An object that fits less by itself may be another one. Of YCB-V right ones fit by 0.46 to 0.92,
those with another's id, but for one in sixty, by less than this."""
BETTER, LEAST = 1.5, 0.15
"""Another reading is named if it fits so many times as well as the given one, and at least so."""
FACTORS = tuple(float(2 ** (k / 7)) for k in range(-9, 10) if k)
"""Other focal lengths that are tried. The best is about right: smaller models stay inside."""
INVERTED = "inverted: they lead from camera to object"
TRANSPOSED = "transposed: cam_R_m2c is written column by column"
UNITS = {f"with depth times {10.0**k:g}": 10.0**k for k in (-3, -2, -1, 1, 2, 3)}


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LabelledDepth:
    """What was measured in an image, and what is said to be there."""

    depth_m: Array32
    """(H, W) [m], 0 = none."""
    intrinsics: CameraIntrinsics
    objects: Sequence[tuple[int, Array]]
    """Object id and T_cam_obj (4, 4) [m] of each object that has a model."""


def require_surfaces(
    images: Sequence[LabelledDepth], models: Mapping[int, ObjectModel], where: str
) -> str:
    """Return a note on how measured depth fits the models' surfaces, if no other reading is right.

    Args:
        images: some of a scene.
        models: by object id.
        where: for messages.

    Returns:
        '' if there is nothing to compare, or another unit of the depth fits best.

    Raises:
        InputError: depth fits clearly better with inverted poses or transposed rotations, or with
            another camera, and then as well as labels that are not doubted: rough labels fit some
            other camera a little better by chance, which is told.
    """
    images = [i for i in images if i.objects]
    if not images:
        return ""
    used = {obj_id for image in images for obj_id, _ in image.objects}
    rng = np.random.default_rng(0)
    points = {k: sample_surface(models[k].mesh, SAMPLES, rng)[0] for k in sorted(used)}
    stated = _share(images, points)
    said = f"measured depth agrees with {stated:.0%} of the pixels of the models"
    if swapped := _swapped(images, points):
        return f"{said}; {swapped}"
    if stated >= SURE:
        return f"checked: {said}."
    shares = {name: _share(read, points) for name, read in _other_readings(images)}
    best = max(shares, key=lambda name: shares[name])
    if shares[best] < max(BETTER * stated, LEAST):
        doubt = "" if stated >= LEAST else "; it cannot tell whether cam_K and poses are right"
        return f"{said}, under no other reading of cam_K and poses clearly more{doubt}."
    if best in UNITS:
        return ""
    said = f"{said}, and {shares[best]:.0%} if the labels are read {best}"
    if best in (INVERTED, TRANSPOSED) or shares[best] >= SURE:
        raise InputError(f"{where}: {said}. Correct them.")
    return f"{said}: correct them, if they are not only rough."


def _swapped(images: Sequence[LabelledDepth], points: Mapping[int, Array]) -> str:
    """Return which objects have each other's ids: each fits badly, and well as the other one."""

    def fit(obj_id: int, model: int) -> float:
        shown = (replace(i, objects=[(model, T) for k, T in i.objects if k == obj_id])
                 for i in images)  # fmt: skip
        return _share([i for i in shown if i.objects], points)

    alone = {k: fit(k, k) for k in points}
    told: list[str] = []
    for a, b in combinations([k for k in points if alone[k] < ALONE], 2):
        other = {a: fit(a, b), b: fit(b, a)}
        if all(other[k] > max(ALONE, BETTER * alone[k]) for k in (a, b)):
            told.append(
                f"object {a} and object {b} seem to be swapped: by itself each agrees with "
                f"{alone[a]:.0%} and {alone[b]:.0%}, exchanged with {other[a]:.0%} and "
                f"{other[b]:.0%}. Correct their obj_id in {GT_FILE}."
            )
    return " ".join(told)


def _other_readings(images: Sequence[LabelledDepth]) -> Iterator[tuple[str, list[LabelledDepth]]]:
    """Yield the images under other conventions, with what these are called."""
    for name, turned in ((INVERTED, se3.invert), (TRANSPOSED, transposed)):
        yield (
            name,
            [replace(i, objects=[(obj_id, turned(T)) for obj_id, T in i.objects]) for i in images],
        )
    for name, unit in UNITS.items():
        yield name, [replace(i, depth_m=unit * i.depth_m) for i in images]
    for factor in FACTORS:
        for name, middle in (
            (f"with focal lengths of cam_K times about {factor:.1f}", 1.0),
            (f"with all of cam_K times about {factor:.1f}, as of an image of another size", factor),
        ):
            yield (
                name,
                [replace(i, intrinsics=_scaled(i.intrinsics, factor, middle)) for i in images],
            )


def _scaled(camera: CameraIntrinsics, focal: float, middle: float) -> CameraIntrinsics:
    """Return a camera whose focal lengths and principal point are multiplied."""
    return replace(
        camera, fx=focal * camera.fx, fy=focal * camera.fy,
        cx=middle * camera.cx, cy=middle * camera.cy,
    )  # fmt: skip


def _share(images: Sequence[LabelledDepth], points: Mapping[int, Array]) -> float:
    """Return the share of the models' pixels whose measured depth agrees."""
    return float(np.mean([_share_of(image, points) for image in images]))


def _share_of(image: LabelledDepth, points: Mapping[int, Array]) -> float:
    """Return the share in one image; what is not measured, or is beside it, does not agree."""
    height, width = image.depth_m.shape
    placed = np.concatenate([se3.transform(T, points[obj_id]) for obj_id, T in image.objects])
    with np.errstate(all="ignore"):
        uv = np.rint(project(image.intrinsics, placed))
    is_somewhere = (placed[:, 2] > NEAREST_M) & np.all(np.abs(uv) < BESIDE * width, axis=1)
    uv, z = uv[is_somewhere].astype(np.int64), placed[is_somewhere, 2]
    cells = np.floor(uv * CELLS / width).astype(np.int64)
    inside = np.all((uv >= 0) & (uv < (width, height)), axis=1)
    beside = np.unique(cells[~inside] @ (2 * int(BESIDE) * CELLS, 1))
    (u, v), z, (column, row) = uv[inside].T, z[inside], cells[inside].T
    nearest = np.full((CELLS, height * CELLS // width + 1), np.inf)
    np.minimum.at(nearest, (column, row), z)
    is_nearest = z == nearest[column, row]
    z, measured = z[is_nearest], image.depth_m[v[is_nearest], u[is_nearest]]
    agree = (measured > 0) & (np.abs(measured - z) < AGREES_M + AGREES_SHARE * z)
    looked_at = len(z) + len(beside)
    return float(np.count_nonzero(agree) / max(looked_at, 1) * np.mean(is_somewhere))
