"""What the depth images say about one object: measured points, averaged and weighted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Array32, Int64, Mask, UInt8
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.clouds import voxel_mean
from realsim.geometry.depth import check_depth, depth_noise_per_m, edge_mask, points_from_depth
from realsim.records import CameraIntrinsics, SupportPlane
from realsim.records.calibration import DepthBias
from realsim.registration.body import Body


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DepthFrame:
    """One depth image and where it was taken."""

    index: int
    """Number of the view."""
    depth_m: Array32
    """(H, W) depth along z [m]; 0 = none."""
    T_world_cam: Array
    """(4, 4) camera in world [m]."""
    read_rgb: Callable[[], UInt8] | None = None
    """Reads the photograph (H, W, 3) that the depth lies on; None = there is none."""


class LazyFrame(DepthFrame):
    """A frame whose image is read every time it is asked for: 256 of them are a gigabyte."""

    __slots__ = ("_read",)

    def __init__(
        self,
        index: int,
        T_world_cam: Array,
        read: Callable[[], Array32] | None = None,
        *,
        depth_m: Array32 | None = None,
        read_rgb: Callable[[], UInt8] | None = None,
    ) -> None:
        """Keep how the image is read; nothing is read.

        Args:
            index: number of the view.
            T_world_cam: (4, 4) camera in world [m].
            read: returns the image; None = it is `depth_m`.
            depth_m: the image itself, as `dataclasses.replace` gives it.
            read_rgb: returns the photograph; None = there is none.
        """
        if read is None and depth_m is None:
            raise InputError(f"view {index} has neither an image nor a way to read it; give one.")
        object.__setattr__(self, "index", index)
        object.__setattr__(self, "T_world_cam", T_world_cam)
        object.__setattr__(self, "read_rgb", read_rgb)
        object.__setattr__(self, "_read", read or (lambda: depth_m))

    @property
    def depth_m(self) -> Array32:  # pyright: ignore[reportIncompatibleVariableOverride]
        """(H, W) depth along z [m]; 0 = none."""
        read: Callable[[], Array32] = object.__getattribute__(self, "_read")
        return read()


def correct_frame(frame: DepthFrame, T_world_cam: Array, bias: DepthBias) -> DepthFrame:
    """Return the frame with another camera pose and the depth's bias taken out; read when asked."""
    return LazyFrame(
        frame.index, T_world_cam, lambda: bias.corrected(frame.depth_m).astype(np.float32),
        read_rgb=frame.read_rgb,
    )  # fmt: skip


def read_frame(frame: DepthFrame) -> DepthFrame:
    """Return the frame with its image in memory."""
    return DepthFrame(index=frame.index, depth_m=frame.depth_m, T_world_cam=frame.T_world_cam)


@dataclass(frozen=True, kw_only=True, slots=True)
class EvidenceConfig:
    """How depth images become points."""

    stride: int = 4
    """Every how many pixels one is used; noise is correlated over about as many, so little is lost.
    With few frames it is lowered until an object has about `points_per_object` points."""
    points_per_object: int = 12_000
    """Wanted measurements per object over all frames: the fit costs 60 ns each and step."""
    reach_m: float = 0.04
    """Measured points within this of the start pose's surface are kept: a start is off by 30 mm at
    most."""
    plane_reach_m: float = 0.15
    """Points this far around an object may carry its support plane; beyond lies other furniture."""
    noise_per_m: float | None = None
    """k of the noise model sigma_z = k z^2 [1/m]; None = measured from the images. A D405 has
    0.08 px / (645 px * 0.018 m) = 0.0069."""
    noise_floor_m: float = 0.0002
    """Least sigma_z: no depth camera is better, and a noiseless image must not weigh infinitely."""
    edge_jump_m: float = 0.010
    """Depth span within 3 px beyond which pixels may be flying (plus slope and noise)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthNoise:
    """Stereo noise: sigma_z = max(floor, k z^2)."""

    per_m: float
    """k [1/m]."""
    floor_m: float
    """[m]."""

    def sigma(self, z: NDArray[np.floating]) -> Array:
        """Return the 1-sigma of depth [m] at depth z [m]."""
        return np.maximum(self.floor_m, self.per_m * np.square(np.asarray(z, dtype=np.float64)))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Cloud:
    """Measured points in world, with what a fit needs to know of each."""

    points: Array
    """(N, 3) [m]."""
    towards: Array
    """(N, 3) unit direction from the point to the camera that saw it."""
    sigmas: Array
    """(N,) 1-sigma [m]."""

    def select(self, keep: Mask | Int64 | slice) -> "Cloud":
        """Return the points where `keep` (N,), or of these numbers."""
        return Cloud(points=self.points[keep], towards=self.towards[keep], sigmas=self.sigmas[keep])


def seen_cloud(points: Array, eyes: Array, sigmas: Array) -> Cloud:
    """Return points (N, 3) as cameras at `eyes` (3,) or (N, 3) saw them, with their sigmas (N,)."""
    towards = eyes - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return Cloud(points=points, towards=towards, sigmas=sigmas)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Evidence:
    """The measured points of a scene, sorted by what they may belong to."""

    noise: DepthNoise
    near: tuple[Cloud, ...]
    """Per object: the points within reach of its start pose."""
    support: Array
    """(N, 3) points around the objects but on none of them: candidates for the plane [m]."""
    stride: int
    """The stride that was used [px]."""


def in_order(frames: Sequence[DepthFrame]) -> list[DepthFrame]:
    """Return the frames in the order of their numbers.

    Raises:
        InputError: there is none, or two have the same number.
    """
    if not frames:
        raise InputError("no depth frames were given; registration needs at least one.")
    ordered = sorted(frames, key=lambda f: f.index)
    if len({f.index for f in ordered}) != len(ordered):
        raise InputError("two depth frames have the same number; view numbers must be unique.")
    return ordered


def check_frames(frames: Sequence[DepthFrame], intrinsics: CameraIntrinsics) -> list[DepthFrame]:
    """Return the frames in the order of their numbers.

    Raises:
        InputError: there is none, two have the same number, or an image is not the camera's.
    """
    ordered = in_order(frames)
    for f in ordered:
        check_depth(f.depth_m, intrinsics)
    return ordered


def measure_noise(frames: Sequence[DepthFrame], config: EvidenceConfig) -> DepthNoise:
    """Return the noise model of the frames: given, or measured from up to 8 of them."""
    k = config.noise_per_m
    if k is None:
        some = frames[:: max(1, len(frames) // 8)]
        k = depth_noise_per_m([f.depth_m for f in some])
    return DepthNoise(per_m=k, floor_m=config.noise_floor_m)


def gather(
    intrinsics: CameraIntrinsics,
    frames: Sequence[DepthFrame],
    bodies: Sequence[Body],
    config: EvidenceConfig,
) -> Evidence:
    """Return the points of all frames near each object's start, and around the objects.

    Args:
        intrinsics: the camera.
        frames: depth images with poses.
        bodies: the objects at their start poses.
        config: settings.
    """
    noise = measure_noise(frames, config)
    stride = _stride(intrinsics, frames, bodies, config)
    near: list[list[Cloud]] = [[] for _ in bodies]
    support: list[Array] = []
    for frame in frames:
        cloud = _frame_cloud(intrinsics, frame, stride, noise, config)
        around = np.zeros(len(cloud.points), dtype=bool)
        on_object = np.zeros(len(cloud.points), dtype=bool)
        for body, kept in zip(bodies, near, strict=True):
            radius = np.linalg.norm(cloud.points - body.center(body.T_start), axis=1)
            around |= radius < body.radius_m + config.plane_reach_m
            close = np.flatnonzero(radius < body.radius_m + config.reach_m)
            d = body.field.distance(cloud.points[close], se3.invert(body.T_start))
            inside = np.zeros(len(cloud.points), dtype=bool)
            inside[close[d < config.reach_m]] = True
            kept.append(cloud.select(inside))
            on_object[close[d < 0.5 * config.reach_m]] = True
        support.append(cloud.points[around & ~on_object][::2])
    return Evidence(
        noise=noise,
        near=tuple(join_clouds(clouds) for clouds in near),
        support=np.concatenate(support),
        stride=stride,
    )


def average_cloud(cloud: Cloud, T_world_obj: Array, size: float) -> Cloud:
    """Return the cloud averaged on voxels of the object's frame (inverse-variance weights).

    The grid lies in the object's frame, so the result moves with the world; points seen from
    different octants are kept apart, so that the two sides of a thin wall are not mixed.

    Args:
        cloud: measured points.
        T_world_obj: (4, 4) the object's start pose.
        size: edge of a voxel [m].
    """
    local = se3.transform(se3.invert(T_world_obj), cloud.points)
    towards = cloud.towards @ T_world_obj[:3, :3]
    octant = (towards > 0) @ np.array([1, 2, 4], dtype=np.int64)
    means = voxel_mean(local, size, 1.0 / np.square(cloud.sigmas), towards, octant)
    length = np.linalg.norm(means.attributes, axis=1, keepdims=True)
    directions = means.attributes / np.where(length > 0, length, 1.0)
    return Cloud(
        points=se3.transform(T_world_obj, means.points),
        towards=directions @ T_world_obj[:3, :3].T,
        sigmas=1.0 / np.sqrt(means.weights),
    )


def without_table(cloud: Cloud, plane: SupportPlane | None, height_m: float) -> Cloud:
    """Return the points more than `height_m` above the plane: the table's are gone."""
    if plane is None:
        return cloud
    z = se3.transform(se3.invert(plane.T_world_table), cloud.points)[:, 2]
    return cloud.select(z > height_m)


def _frame_cloud(
    intrinsics: CameraIntrinsics,
    frame: DepthFrame,
    stride: int,
    noise: DepthNoise,
    config: EvidenceConfig,
) -> Cloud:
    """Return the trusted points of one frame in world."""
    z = frame.depth_m
    # Within 3 px a surface seen at 75 degrees spans about 8 pixel pitches.
    slope = 8.0 * z / min(intrinsics.fx, intrinsics.fy)
    jump = config.edge_jump_m + slope + 6.0 * noise.sigma(z)
    trusted = np.where(edge_mask(z, jump), np.float32(0), z)
    points_cam, _ = points_from_depth(trusted, intrinsics, stride)
    points = se3.transform(frame.T_world_cam, points_cam)
    return seen_cloud(points, frame.T_world_cam[:3, 3], noise.sigma(points_cam[:, 2]))


def _stride(
    intrinsics: CameraIntrinsics,
    frames: Sequence[DepthFrame],
    bodies: Sequence[Body],
    config: EvidenceConfig,
) -> int:
    """Return the stride that leaves about the wanted number of points on the smallest object."""
    seen: list[float] = []
    for body in bodies:
        center = body.center(body.T_start)
        z = np.array([np.linalg.norm(f.T_world_cam[:3, 3] - center) for f in frames])
        # A disc of half the bounding radius stands for the silhouette.
        seen.append(float(np.sum(np.pi * np.square(0.5 * body.radius_m * intrinsics.fx / z))))
    fewest = min(seen) if seen else 0.0
    return int(np.clip(np.sqrt(fewest / config.points_per_object), 1, config.stride))


def join_clouds(clouds: Sequence[Cloud]) -> Cloud:
    """Return the clouds one after the other."""
    return Cloud(
        points=np.concatenate([c.points for c in clouds]),
        towards=np.concatenate([c.towards for c in clouds]),
        sigmas=np.concatenate([c.sigmas for c in clouds]),
    )
