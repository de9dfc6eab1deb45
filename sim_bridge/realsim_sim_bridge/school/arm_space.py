"""What the arm must not touch: the table, the objects and itself.

The arm is a set of spheres that contain Franka's own coarse collision capsules; objects are points
on their surfaces. Every check takes a batch of configurations at once.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim_sim_bridge.school import panda
from realsim_sim_bridge.school.candidates import Surroundings

Array = NDArray[np.float64]
Codes = NDArray[np.int64]

FREE, IN_TABLE, IN_ITSELF, AT_LIMITS = -1, -2, -3, -4
"""What stops a configuration; an instance number (0 or more) is the object that it touches."""
NEAR_LINKS, FAR_LINKS = (0, 1, 2, 3), (6, 7, 8)
"""Links that can meet although they are not neighbours: base and upper arm against wrist and
hand."""


def in_words(code: int) -> str:
    """Return what stopped a configuration, for a sentence that starts with the move."""
    words = {
        IN_TABLE: "collides with the table",
        IN_ITSELF: "collides with the arm itself",
        AT_LIMITS: "leaves the joint limits or the arm's reach",
    }
    return words.get(code, f"collides with the object of instance {code}")


@dataclass(frozen=True, kw_only=True, slots=True)
class ArmSpaceConfig:
    """Distances the arm keeps."""

    clearance_m: float = 0.01
    """Least distance of the arm from objects and table [m]: above the objects' point spacing."""
    self_clearance_m: float = 0.0
    """Least distance of wrist and hand from base and upper arm [m]; the capsules are coarse."""


class ArmSpace:
    """The obstacles around an arm whose base stands at T_table_base."""

    def __init__(self, T_table_base: Array, obstacles: Surroundings, config: ArmSpaceConfig):
        """Prepare the checks.

        Args:
            T_table_base: (4, 4) the arm's base [m].
            obstacles: points on all objects, the grasped one too, in the table's frame.
            config: distances to keep.
        """
        from scipy.spatial import KDTree

        self._config, self._instances = config, obstacles.instances
        T_base_table = se3.invert(T_table_base)
        self._up, self._height = T_table_base[2, :3], T_table_base[2, 3]
        points = se3.transform(T_base_table, obstacles.points)
        self._tree = KDTree(points) if len(points) else None
        arm, hand = panda.ARM_CAPSULES, panda.HAND_CAPSULES
        self._spheres = {False: panda.spheres_of(arm), True: panda.spheres_of(arm + hand)}

    def blame(self, frames: Array, *, with_hand: bool) -> Codes:
        """Return what stops each configuration (...,), or FREE.

        Args:
            frames: (..., 9, 4, 4) of `panda.link_frames`.
            with_hand: whether the hand's capsules are checked too; near an object they are too
                coarse and its boxes are checked instead.
        """
        spheres = self._spheres[with_hand]
        centers = panda.sphere_centers(spheres, frames)
        reach = spheres.radii + self._config.clearance_m
        codes = np.full(centers.shape[:-2], FREE, dtype=np.int64)
        codes[self._touches_itself(centers, spheres)] = IN_ITSELF
        heights = centers @ self._up + self._height
        codes[np.any(heights < reach, axis=-1)] = IN_TABLE
        touched = self._object_touched(centers, reach)
        return np.where(touched >= 0, touched, codes)

    def _touches_itself(self, centers: Array, spheres: panda.Spheres) -> NDArray[np.bool_]:
        """Return whether wrist or hand meet base or upper arm (...,)."""
        near = np.isin(spheres.links, NEAR_LINKS)
        far = np.isin(spheres.links, FAR_LINKS)
        least = spheres.radii[near][:, None] + spheres.radii[far] + self._config.self_clearance_m
        a, b = centers[..., near, :], centers[..., far, :]
        # |a - b|^2 = |a|^2 + |b|^2 - 2 a b, without an array of all differences.
        squared = (
            np.sum(a * a, axis=-1)[..., :, None]
            + np.sum(b * b, axis=-1)[..., None, :]
            - 2 * a @ np.swapaxes(b, -1, -2)
        )
        return np.any(squared < least**2, axis=(-1, -2))

    def _object_touched(self, centers: Array, reach: Array) -> Codes:
        """Return the instance of an object that a sphere touches (...,), or FREE."""
        touched = np.full(centers.shape[:-2], FREE, dtype=np.int64)
        if self._tree is None:
            return touched
        distance, index = self._tree.query(
            centers.reshape(-1, 3), distance_upper_bound=float(reach.max())
        )
        hit = (distance.reshape(centers.shape[:-1]) < reach).reshape(-1, len(reach))
        rows, columns = np.nonzero(hit)
        flat = touched.reshape(-1)
        flat[rows] = self._instances[index.reshape(hit.shape)[rows, columns]]
        return flat.reshape(touched.shape)
