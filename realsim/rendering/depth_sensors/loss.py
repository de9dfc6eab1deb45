"""What a depth sensor loses: too little light comes back, the surface shines, or chance.

The light that a point returns from the sensor's own projector, or what texture has left of its
contrast at that distance, falls as 1/z^2, with the cosine of the angle of view, and with the
surface's reflectance (Lambert). A pixel is lost when that signal is under a threshold that varies
from place to place: a normal distribution in the logarithm of the signal.

Which surfaces only one eye of a depth camera sees: they have no match, so no depth.

Exactly, by rays from the surface to either eye; and from a depth image alone, by a scan along its
rows, which knows nothing of what the image does not show.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from realsim.arrays import Array, Array32, Mask, UInt8
from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.geometry.colors import light_of_bytes, luminance
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Material
from realsim.rendering.rays import PlacedMesh, RayScene, rotated

DARK_REFLECTANCE, DARK_SPREAD = 0.03, 0.6
"""Linear reflectance at which half of a dark surface is lost, and how soft that limit is [ln]:
sRGB 48 of 255, black plastic and rubber, which projected patterns show in patches."""
SHINY_LOSS = 0.6
"""Share lost of a polished metal seen from the working distance: its highlight blinds, and its
mirror image of the surroundings gives wrong matches."""
TEXELS = 10_000
"""Number of texels, evenly spread, that make a texture's mean."""


def signal_loss(
    depth_m: Array32,
    cosine: Array32,
    range_m: float,
    spread: float,
    reflectance: Array32 | None = None,
) -> Array32:
    """Return the share (H, W) of pixels lost for want of signal: Phi(-ln(S) / spread).

    S = (range / z)^2 cos(angle) reflectance is the signal over the threshold.

    Args:
        depth_m: (H, W) exact depth [m], 0 = nothing.
        cosine: (H, W) of the angle between ray and surface normal.
        range_m: depth at which half of a white surface seen frontally is lost [m].
        spread: standard deviation of the threshold [natural logarithm].
        reflectance: (H, W) linear [0, 1]; None = white.
    """
    from scipy.special import ndtr

    z = np.where(depth_m > 0, depth_m, np.float32(range_m))
    signal = np.square(np.float32(range_m) / z) * np.maximum(cosine, 1e-6)
    if reflectance is not None:
        signal = signal * np.maximum(reflectance, 1e-6)
    return np.asarray(ndtr(-np.log(signal) / np.float32(spread)), np.float32)


def cosine_of_view(disparity: Array32, intrinsics: CameraIntrinsics) -> Array32:
    """Return the cosine (H, W) of the angle between each pixel's ray and its surface's normal.

    On a plane n . X = 1 inverse depth is w = n . ray, linear in the pixel: with its slopes
    n = (fx w_u, fy w_v, w - (u - cx) w_u - (v - cy) w_v) and cos = w / (|n| |ray|). Disparity
    is w times a constant, which cancels.
    """
    i = intrinsics
    u = np.arange(i.width, dtype=np.float32)[None] - np.float32(i.cx)
    v = np.arange(i.height, dtype=np.float32)[:, None] - np.float32(i.cy)
    du, dv = _smooth_slope(disparity, 1), _smooth_slope(disparity, 0)
    nx, ny, nz = np.float32(i.fx) * du, np.float32(i.fy) * dv, disparity - u * du - v * dv
    ray = np.sqrt((u / np.float32(i.fx)) ** 2 + (v / np.float32(i.fy)) ** 2 + 1)
    length = np.maximum(np.sqrt(nx * nx + ny * ny + nz * nz) * ray, 1e-9)
    return (disparity / length).astype(np.float32, copy=False)


def grazing_loss(cosine: Array32, from_deg: float, to_deg: float) -> Array32:
    """Return the share (H, W) lost because the surface is seen edge-on: a ramp in the angle."""
    angle = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    span = max(to_deg - from_deg, 1e-6)
    return np.clip((angle - from_deg) / span, 0, 1).astype(np.float32)


def _smooth_slope(values: Array32, axis: int) -> Array32:
    """Return the slope per pixel, the smaller of both sides', so that edges do not count."""
    if values.shape[axis] < 2:
        return np.zeros_like(values)
    step = np.diff(values, axis=axis)
    first, last = np.take(step, [0], axis=axis), np.take(step, [-1], axis=axis)
    ahead = np.concatenate([step, last], axis=axis)
    behind = np.concatenate([first, step], axis=axis)
    return np.where(np.abs(ahead) < np.abs(behind), ahead, behind)


def blob_mask(
    rng: np.random.Generator, shape: tuple[int, int], per_megapixel: float, radius_px: float
) -> Mask:
    """Return where (H, W) holes without cause lie: ellipses at random."""
    import cv2

    height, width = shape
    mask = np.zeros(shape, np.uint8)
    for _ in range(int(rng.poisson(per_megapixel * height * width / 1e6))):
        center = (int(rng.integers(width)), int(rng.integers(height)))
        half = np.maximum(1, np.round(rng.gamma(4.0, radius_px / 4.0, 2)))
        angle = float(rng.uniform(0, 180))
        cv2.ellipse(mask, center, (int(half[0]), int(half[1])), angle, 0, 360, 1, -1)
    return mask > 0


def material_loss(material: Material) -> float:
    """Return the share of pixels that a surface of this material is expected to lose.

    Two causes, independent of each other: dark surfaces return too little light, and polished metal
    returns it in one direction. A rough guess, for materials that nobody has measured; a fit to
    real frames of the object (benchmarks/labels_losses.py) is better.
    """
    from scipy.special import ndtr

    bright = max(float(luminance(_mean_color(material))), 1e-4)
    dark = float(ndtr(np.log(DARK_REFLECTANCE / bright) / DARK_SPREAD))
    shiny = SHINY_LOSS * material.metallic * (1 - material.roughness) ** 2
    return 1 - (1 - dark) * (1 - shiny)


def look_of(placed: PlacedMesh) -> Material:
    """Return a mesh's material with its mean colour as the base colour, without images.

    A mesh without a material has the mean of its texture or colours, else a light grey.
    """
    look, mesh = placed.material, placed.mesh
    if look is None:
        look = Material()
        own = mesh.colors if mesh.texture is None else mesh.texture
        mean = np.array(look.base_color) if own is None else _mean_srgb(own)
    else:
        mean = _mean_color(look)
    r, g, b = np.clip(mean, 0.0, 1.0).tolist()
    return Material(base_color=(r, g, b), roughness=look.roughness, metallic=look.metallic)


def _mean_color(material: Material) -> Array:
    """Return the linear base colour (3,), averaged over the image where there is one."""
    base = np.array(material.base_color)
    image = material.base_color_image
    return base if image is None else base * _mean_srgb(image)


def _mean_srgb(values: UInt8) -> Array:
    """Return the mean linear light (3,) of 8-bit sRGB values (..., 3)."""
    flat = values.reshape(-1, 3)
    flat = flat[:: max(1, len(flat) // TEXELS)]
    return light_of_bytes(flat).mean(0)


LIFT = 3e-4
"""Share of the way to the eye by which rays start above the surface: more than float32 and the
rendered depth are off (1e-6), less than a sheet of paper at half a metre (0.15 mm)."""


def shadow_mask(
    scene: RayScene,
    depth_m: ArrayLike,
    intrinsics: CameraIntrinsics,
    T_world_cam: ArrayLike,
    *,
    baseline_m: float,
    eye_offset_m: float = 0.0,
    border: bool = True,
    border_margin_px: float = 0.0,
) -> Mask:
    """Return where (H, W) a surface is hidden from an eye, or outside the second eye's picture.

    The eyes (or eye and projector) stand on the x axis of the picture's camera, at `eye_offset_m`
    and at `eye_offset_m + baseline_m`.

    Args:
        scene: everything that can hide something.
        depth_m: (H, W) exact depth along z of the picture [m], 0 = nothing.
        intrinsics: the picture's camera, distorted or not.
        T_world_cam: (4, 4) the picture's camera in world [m].
        baseline_m: distance of the eyes [m].
        eye_offset_m: where the first eye stands [m]; 0 = the picture is its own.
        border: whether what lies outside the second eye's picture (its axes are parallel and it has
            the same lens) counts, too.
        border_margin_px: how near to its left border a match is lost [px].

    Raises:
        InputError: sizes differ, or the pose is not rigid.
    """
    depth = np.asarray(depth_m, dtype=np.float32)
    require_same_size(depth, intrinsics)
    T = se3.check_rigid(T_world_cam, "T_world_cam")
    table = camera.ray_table(intrinsics)
    seen = (depth > 0) & np.isfinite(table[..., 0])
    points = table[seen] * depth[seen][:, None]
    hidden = np.zeros(len(points), dtype=bool)
    for x in (eye_offset_m, eye_offset_m + baseline_m):
        if x != 0:  # what the camera sees is not hidden from its own place
            hidden |= _hidden_from(scene, points, np.array([x, 0.0, 0.0]), T)
    if border:
        u = np.nonzero(seen)[1] - intrinsics.fx * baseline_m / points[:, 2]
        hidden |= u < border_margin_px - 0.5
    mask = np.zeros(depth.shape, dtype=bool)
    mask[seen] = hidden
    return mask


def require_same_size(
    image: NDArray[np.generic], intrinsics: CameraIntrinsics, name: str = "the depth picture"
) -> None:
    """Refuse a depth picture that is not of the camera's size.

    Raises:
        InputError: the sizes differ, or the array is no picture.
    """
    if image.ndim != 2:
        raise InputError(
            f"{name}: a depth picture has rows and columns; found an array of shape {image.shape}."
        )
    if image.shape != (intrinsics.height, intrinsics.width):
        raise InputError(
            f"{name} is {image.shape[1]}x{image.shape[0]}, the camera "
            f"{intrinsics.width}x{intrinsics.height}. Give the intrinsics of the depth pictures, "
            "at their size."
        )


def _hidden_from(scene: RayScene, points: Array32, eye: Array, T_world_cam: Array) -> Mask:
    """Return which points (N, 3) of the camera's axes something hides from an eye (3,)."""
    if len(points) == 0:
        return np.zeros(0, dtype=bool)
    towards = eye.astype(np.float32) - points
    starts = se3.transform(T_world_cam, (points + np.float32(LIFT) * towards).astype(np.float64))
    directions = rotated(towards, T_world_cam[:3, :3])
    # The ray ends at the eye: a wall behind it hides nothing.
    return scene.occluded(starts, directions, until=1 - LIFT)


def half_occluded(
    disparity: Array32,
    *,
    second_eye: float = 1.0,
    first_eye: float = 0.0,
    border: bool = True,
    border_margin_px: float = 0.0,
) -> Mask:
    """Return where (H, W) an eye cannot see what the picture shows, from the picture alone.

    A point at column u appears at u - s d in an eye that stands s baselines to the right. Along a
    row that order is kept unless something nearer jumps in front: for s > 0 something at u' > u
    with u' - s d' < u - s d hides u, which one running minimum from the right finds for all pixels;
    for s < 0 the mirror image. What leaves the second eye's picture has no match either.

    Args:
        disparity: (H, W) for the whole baseline [px], 0 = unknown.
        second_eye: where the second eye stands [baselines].
        first_eye: where the first eye stands [baselines]; 0 = the picture is its own.
        border: whether what leaves the picture (u < d) counts.
        border_margin_px: what comes so near to leaving it counts, too [px].
    """
    known = disparity > 0
    lost = np.zeros(disparity.shape, dtype=bool)
    for s in (second_eye, first_eye):
        if s > 0:
            lost |= _overtaken(disparity * np.float32(s), known)
        elif s < 0:
            lost |= _overtaken(disparity[:, ::-1] * np.float32(-s), known[:, ::-1])[:, ::-1]
    if border:
        u = np.arange(disparity.shape[1], dtype=np.float32)
        lost |= u - disparity < border_margin_px - 0.5
    return known & lost


def _overtaken(shift: Array32, known: Mask) -> Mask:
    """Return which pixels (H, W) one further to the right overtakes when all move left."""
    u = np.arange(shift.shape[1], dtype=np.float32)
    moved = np.where(known, u - shift, np.float32(1e9))
    least = np.minimum.accumulate(moved[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(shift.shape, dtype=bool)
    hidden[:, :-1] = least[:, 1:] < moved[:, :-1]
    return hidden
