"""Where the cameras of a generated scene stand: on a hemisphere over the table, inside nothing."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.records import CameraIntrinsics
from realsim_sim_bridge.synthetic.config import hemisphere_cameras

RANGES: dict[str, tuple[float, float]] = {"far": (1.0, 2.0), "d405": (0.25, 0.50)}
"""Distances by name [m]: the paper's, and the one a D405 is made for."""
FOCAL: dict[str, float] = {"d405": 0.506, "d415": 0.722, "d435": 0.722, "structured_light": 0.84}
"""Focal length as a share of the image's width: fields of view of 89, 69, 69 and 61 deg (colour
images of the D405, D415 and D435, and of PrimeSense's Carmine)."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewConfig:
    """Which views of a scene are rendered."""

    count: int = 256
    """The paper's."""
    radius_m: tuple[float, float] = RANGES["far"]
    """Distance of the camera from the middle of the table top, or from what it looks at [m]."""
    elevation_deg: tuple[float, float] = (15.0, 85.0)
    """Lowest and highest elevation [deg]."""
    size: tuple[int, int] = (1920, 1080)
    """Width and height of the images [px]."""
    clearance_m: float = 0.05
    """No camera is nearer to a surface than this [m]: half of a D405's nearest depth."""
    near_m: float = 0.8
    """Cameras nearer than this are arranged around a point among the objects, which is drawn for
    each; those farther see all of them from around the middle of the table [m]."""
    tries: int = 40
    """So often a camera that stands in something is drawn anew."""

    def __post_init__(self) -> None:
        """Check counts, distances and sizes.

        Raises:
            InputError: numbers that cannot be.
        """
        near, far = self.radius_m
        if not 0.1 <= near <= far <= 5.0:
            raise InputError(
                f"cameras {near:g} to {far:g} m away; 0.1 <= least <= most <= 5 m is accepted: "
                "nearer ones stand in the table or the objects (--radius 0.25-0.5)."
            )
        width, height = self.size
        if not (16 <= width <= 8192 and 16 <= height <= 8192):
            raise InputError(f"images of {width}x{height} px; 16 to 8192 each are accepted.")
        if not 1 <= self.count <= 100_000:
            raise InputError(f"{self.count} views a scene; 1 to 100000 are accepted.")


def intrinsics_of(profile: str, size: tuple[int, int]) -> CameraIntrinsics:
    """Return the camera of a depth profile at an image size, without distortion."""
    width, height = size
    f = FOCAL.get(profile, FOCAL["d435"]) * width
    return CameraIntrinsics(
        width=width, height=height, fx=f, fy=f, cx=(width - 1) / 2, cy=(height - 1) / 2
    )


def views(
    points: Sequence[Array],
    config: ViewConfig,
    rng: np.random.Generator,
    rims: Sequence[Array] = (),
) -> Array:
    """Return cameras (N, 4, 4) in the table's frame.

    Args:
        points: corners (V, 3) of every convex part of the objects where they lie [m].
        config: how many, how far.
        rng: source of all chance.
        rims: convex parts of the table above its top surface [m].

    Raises:
        InputError: no free place is found for a camera.
    """
    solids = [_planes(part) for part in (*points, *rims)]
    corners = np.concatenate(list(points))
    is_near = config.radius_m[0] < config.near_m
    middle = np.array([0.0, 0.0, 0.5 * float(corners[:, 2].max()) if is_near else 0.0])
    low, high = np.quantile(corners[:, :2], (0.1, 0.9), axis=0)
    found = np.empty((config.count, 4, 4))
    due = np.arange(config.count)
    for _ in range(config.tries):
        Ts = hemisphere_cameras(middle, config.radius_m, len(due), rng, config.elevation_deg)
        if is_near:
            Ts[:, :2, 3] += rng.uniform(low, high, (len(due), 2))
        found[due] = Ts
        due = due[~_free(Ts[:, :3, 3], solids, config.clearance_m)]
        if len(due) == 0:
            return found
    raise InputError(
        f"{len(due)} of {config.count} cameras at {config.radius_m[0]:g} to "
        f"{config.radius_m[1]:g} m stand in the objects or the table whatever is tried; give a "
        "larger --radius."
    )


def _planes(part: Array) -> Array:
    from scipy.spatial import ConvexHull

    hull: Any = ConvexHull(part)
    return np.asarray(hull.equations, dtype=np.float64)


def _free(eyes: Array, solids: Sequence[Array], clearance_m: float) -> Mask:
    """Return (N,) whether eyes (N, 3) are above the table and clear of every convex part.

    The greatest signed distance to a hull's planes is at most the distance to the hull.
    """
    free = eyes[:, 2] > clearance_m
    for planes in solids:
        away = (eyes @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        free &= away > clearance_m
    return free
