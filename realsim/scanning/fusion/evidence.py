"""Which pixels of which frames are trusted, and what the frames must be to be fused at all.

The parts of the depth images in which the object can be, cleaned and side by side in memory.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64
from realsim.compiled import njit
from realsim.errors import InputError, UnitError
from realsim.geometry import se3
from realsim.geometry.camera import project, ray_table
from realsim.geometry.depth import check_depth, depth_noise_per_m, edge_mask
from realsim.geometry.point_loops import pixel
from realsim.records import CameraIntrinsics
from realsim.registration.evidence import DepthNoise
from realsim.scanning.fusion.result import FusionConfig, FusionFrame

LEAST_FRAMES = 3
"""Two views neither check each other nor see around an object."""
LONGEST_M = 20.0
"""A median depth above this is not in metres: no table is that far from a camera."""
NOISE_FRAMES = 6
"""Frames from which the noise is measured; more give the same figure."""
NOISE_SPAN = 4.0
"""Noise sigmas that a smooth surface may span in the window besides its slope."""
TRUNCATION_SIGMAS = 3.0
"""Truncation in sigmas of the depth at the usual distance."""
CLOUD_COLUMNS = 320
"""So many columns of every image are used to find the plane and the object: every fourth of
1280."""


def checked_frames(
    frames: Sequence[FusionFrame], intrinsics: CameraIntrinsics
) -> tuple[list[FusionFrame], list[str]]:
    """Return the frames that hold depth, in the order of their numbers, and notes on the others.

    Raises:
        InputError: too few frames, one of another size, twice the same number, no depth, all alike.
        UnitError: the depth cannot be in metres.
    """
    ordered = sorted(frames, key=lambda f: f.index)
    if len({f.index for f in ordered}) != len(ordered):
        raise InputError("two frames have the same number; view numbers must be unique.")
    kept: list[FusionFrame] = []
    notes: list[str] = []
    for f in ordered:
        _check_frame(f, intrinsics)
        if np.any(f.depth_m > 0):
            kept.append(f)
        else:
            notes.append(f"view {f.index} has no depth and was not used.")
    if ordered and not kept:
        raise InputError(
            f"none of the {len(ordered)} frames has depth (all pixels are 0). Was the depth stream "
            "recorded, and is its unit right?"
        )
    if len(kept) < LEAST_FRAMES:
        raise InputError(
            f"{len(kept)} of {len(ordered)} frames have depth; at least {LEAST_FRAMES} from "
            "different sides are needed, 24 around the object are usual."
        )
    _check_different(kept)
    return kept, notes


def _check_frame(frame: FusionFrame, intrinsics: CameraIntrinsics) -> None:
    """Raise if one frame is not the camera's, not in metres, or has an impossible pose."""
    try:
        check_depth(frame.depth_m, intrinsics)
    except InputError as error:
        raise type(error)(f"view {frame.index}: {error}") from error
    se3.check_rigid(frame.T_world_cam, f"T_world_cam of view {frame.index}")
    if frame.rgb is not None and frame.rgb.shape != (*frame.depth_m.shape, 3):
        raise InputError(
            f"view {frame.index}: the picture has shape {frame.rgb.shape}, its depth "
            f"{frame.depth_m.shape}; colours of the same pixels are needed (aligned to depth)."
        )
    known = frame.depth_m[frame.depth_m > 0]
    if len(known) and np.median(known) > LONGEST_M:
        raise UnitError(
            f"view {frame.index}: the median depth is {np.median(known):.4g}; at most "
            f"{LONGEST_M:g} m is accepted. Millimetres? Multiply by the depth unit (0.001)."
        )


def _check_different(frames: Sequence[FusionFrame]) -> None:
    """Raise if all frames are one and the same."""
    first = frames[0]
    if all(np.array_equal(f.depth_m, first.depth_m) for f in frames[1:]):
        raise InputError(
            f"all {len(frames)} depth images are identical; one view repeated does not show an "
            "object from all sides. Was the same file read each time?"
        )
    centers = np.stack([f.T_world_cam[:3, 3] for f in frames])
    turns = se3.angle(se3.invert(first.T_world_cam) @ np.stack([f.T_world_cam for f in frames]))
    if np.ptp(centers, axis=0).max() < 1e-3 and np.max(turns) < 1e-2:
        raise InputError(
            f"all {len(frames)} cameras stand at the same place (within 1 mm and 0.6 deg); an "
            "object has to be seen from different sides. Are the poses those of the views?"
        )


def measured_noise(frames: Sequence[FusionFrame], config: FusionConfig) -> DepthNoise:
    """Return sigma_z = max(floor, k z^2), with k given or measured from some of the frames."""
    k = config.noise_per_m
    if k is None:
        some = frames[:: max(1, len(frames) // NOISE_FRAMES)]
        k = depth_noise_per_m([f.depth_m for f in some])
    return DepthNoise(per_m=k, floor_m=config.noise_floor_m)


def fitted_to_noise(
    frames: Sequence[FusionFrame], noise: DepthNoise, config: FusionConfig
) -> FusionConfig:
    """Return the settings with a truncation of three sigma where the noise is larger than usual.

    At half the resolution a stereo camera is twice as noisy; points beyond the truncation are not
    averaged, and what is left of their distribution is narrower and pulled to the surface.
    """
    depths = [np.median(f.depth_m[f.depth_m > 0]) for f in frames]
    sigma = float(noise.sigma(np.array([np.median(depths)]))[0])
    return replace(config, truncation_m=max(config.truncation_m, TRUNCATION_SIGMAS * sigma))


def trusted_depth(
    depth_m: Array32, intrinsics: CameraIntrinsics, noise: DepthNoise, config: FusionConfig
) -> Array32:
    """Return the depth (h, w) that is trusted; 0 = none, negative = an edge.

    At an edge, where pixels fly, the surface is not known, but the view still sees through what is
    in front of it: the negative of a depth is returned there. Without it the space around every
    silhouette would stay unseen and count as solid, 3 mm wide at 640 px. A pixel that is as far as
    the farthest around (within the jump that is allowed) is seen through up to its own depth:
    matching smears the near surface over the far one, hardly the far one over the near. Any
    other is seen through up to the nearest depth around only.

    A smooth surface seen at `edge_slope_deg` spans (2 m + 1) z tan(slope) / f in the window; what
    spans more than that, the noise and `edge_jump_m` is an edge.

    Args:
        depth_m: (h, w) a depth image or a part of one [m].
        intrinsics: gives the size of a pixel only.
        noise: of the camera.
        config: settings.
    """
    import cv2

    near, far = config.depth_limits_m
    z = np.where((depth_m >= near) & (depth_m <= far), depth_m, np.float32(0))
    window = 2 * config.edge_px + 1
    slope = window * np.tan(np.radians(config.edge_slope_deg)) / min(intrinsics.fx, intrinsics.fy)
    k = np.float32(NOISE_SPAN * noise.per_m)
    jump = np.float32(config.edge_jump_m) + np.float32(slope) * z + k * z * z
    kernel = np.ones((window, window), np.uint8)
    nearest = np.asarray(cv2.erode(np.where(z > 0, z, np.float32(np.inf)), kernel), np.float32)
    farthest = np.asarray(cv2.dilate(z, kernel), np.float32)
    seen_through = np.where(farthest - z <= jump, z, nearest)
    return np.where(edge_mask(z, jump, config.edge_px) & (z > 0), -seen_through, z)


def sparse_cloud(
    frames: Sequence[FusionFrame], intrinsics: CameraIntrinsics, config: FusionConfig
) -> tuple[Array, Array, Int32]:
    """Return points (N, 3) in world, their depth (N,) [m] and the number (N,) of their frame.

    Every fourth pixel of 1280 is used, edges and all: enough to find a plane and what stands on it.
    """
    s = cloud_stride(intrinsics)
    rays = ray_table(intrinsics)[::s, ::s]
    near, far = config.depth_limits_m
    points: list[Array] = []
    depths: list[Array] = []
    owners: list[Int32] = []
    for number, frame in enumerate(frames):
        z = frame.depth_m[::s, ::s]
        good = (z >= near) & (z <= far) & np.isfinite(rays[..., 0])
        known = z[good].astype(np.float64)
        points.append(se3.transform(frame.T_world_cam, rays[good] * known[:, None]))
        depths.append(known)
        owners.append(np.full(len(known), number, np.int32))
    return np.concatenate(points), np.concatenate(depths), np.concatenate(owners)


def cloud_stride(intrinsics: CameraIntrinsics) -> int:
    """Return every how many pixels one is used for the sparse cloud."""
    return max(1, round(intrinsics.width / CLOUD_COLUMNS))


# --- the parts that are used ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Crops:
    """The part of every depth image in which the object can be, trusted pixels only."""

    depths: Array32
    """(F, h, w) depth [m], 0 = none, negative = an edge (see `trusted_depth`);
    parts smaller than the largest are filled up with 0."""
    corners: Int64
    """(F, 2) pixel x, y of the parts' first pixel."""
    camera: Array
    """(13,) fx fy cx cy, the eight distortion terms, and the greatest squared radius of the
    lens model's range in normalised coordinates."""
    noise: Array
    """(2,) k [1/m] and least sigma_z [m]."""


def cropped(
    intrinsics: CameraIntrinsics,
    frames: Sequence[FusionFrame],
    box: tuple[Array, Array, Array],
    noise: DepthNoise,
    config: FusionConfig,
) -> Crops:
    """Return the parts of the frames that see a box, cleaned.

    Args:
        intrinsics: the camera.
        frames: the frames.
        box: T_world_table (4, 4), least and greatest corner (3,) in that frame [m].
        noise: of the camera.
        config: settings.
    """
    T_world_table, low, high = box
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 5)] * 3, indexing="ij"), -1).reshape(-1, 3)
    corners_world = se3.transform(T_world_table, low + grid * (high - low))
    size = np.array([intrinsics.width, intrinsics.height])
    parts: list[Array32] = []
    starts: list[Int64] = []
    for frame in frames:
        local = se3.transform(se3.invert(frame.T_world_cam), corners_world)
        uv = project(intrinsics, local[local[:, 2] > 0.02])
        uv = uv if len(uv) else np.zeros((1, 2))
        pad = 2 + config.edge_px
        first = np.clip(np.floor(uv.min(0)).astype(np.int64) - pad, 0, size - 1)
        last = np.clip(np.ceil(uv.max(0)).astype(np.int64) + pad + 1, first + 1, size)
        part = frame.depth_m[first[1] : last[1], first[0] : last[0]]
        parts.append(trusted_depth(part, intrinsics, noise, config))
        starts.append(first)
    shape = np.max([p.shape for p in parts], axis=0)
    depths = np.zeros((len(parts), *shape), np.float32)
    for number, p in enumerate(parts):
        depths[number, : p.shape[0], : p.shape[1]] = p
    rays = ray_table(intrinsics)[::8, ::8, :2]
    radius2 = float(np.nanmax(np.sum(np.square(rays, dtype=np.float64), axis=-1)))
    i = intrinsics
    return Crops(
        depths=depths,
        corners=np.stack(starts),
        camera=np.array([i.fx, i.fy, i.cx, i.cy, *i.distortion, radius2]),
        noise=np.array([noise.per_m, noise.floor_m]),
    )


@njit(inline="always")
def pixel_of(camera: Array, x: float, y: float, z: float) -> tuple[int, int]:
    """Return the pixel (u, v) that sees a camera point, (-1, -1) if the lens model has none."""
    a, b = x / z, y / z
    if a * a + b * b > camera[12]:
        return -1, -1
    u, v = pixel(camera, a, b)
    return int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
