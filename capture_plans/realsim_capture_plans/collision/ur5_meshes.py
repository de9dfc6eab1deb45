"""The UR5's published collision meshes, against which our shapes and plans are judged.

They come with the optional wheel `example-robot-data` (ur_description, BSD). Everything here goes
its own way - pinocchio's URDF reader, triangle trees, all pairs of links but the neighbours - so
that agreement with `CollisionModel` proves something.
"""

from importlib.metadata import PackageNotFoundError, distribution
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Mask
from realsim.errors import MissingLibraryError
from realsim.interop import import_pinocchio, offer
from realsim.robots.arm import UR5, arm_of
from realsim.robots.coal_geometry import coal_shape
from realsim.robots.shapes import Mount, WorkCell
from realsim_capture_plans.collision.model import CollisionModel, bodies_of

URDF = "ur_description/urdf/ur5_robot.urdf"
"""Inside the wheel's folder of robots."""
URDF_LINKS = (
    "base_link", "shoulder_link", "upper_arm_link", "forearm_link",
    "wrist_1_link", "wrist_2_link", "wrist_3_link",
)  # fmt: skip
"""In the order of the arm's `link_names`."""
BASE_LINK_FROM_BASE = np.diag([-1.0, -1.0, 1.0, 1.0])
"""ROS's `base_link` is the controller's base, turned by 180 degrees about z."""


def robots_folder() -> Path:
    """Return the folder of robots of the `example-robot-data` wheel.

    Raises:
        MissingLibraryError: it is not installed.
    """
    try:
        wheel = distribution("example-robot-data")
    except PackageNotFoundError:
        raise MissingLibraryError(
            "the UR5's meshes come with the package example-robot-data, which is not installed. "
            f"{offer('looks')}."
        ) from None
    folder = Path(str(wheel.locate_file("cmeel.prefix/share/example-robot-data/robots")))
    if not (folder / URDF).is_file():
        raise MissingLibraryError(f"example-robot-data is installed but {folder / URDF} is not.")
    return folder


class MeshModel:
    """A nominal UR5 of triangles with a mount in a work cell: does it touch anything?"""

    def __init__(self, mount: Mount, cell: WorkCell) -> None:
        """Load the meshes.

        Raises:
            MissingLibraryError: `example-robot-data` is not installed.
        """
        pin = import_pinocchio()

        folder = robots_folder()
        urdf, packages = str(folder / URDF), [str(folder.parent.parent)]
        self._model = pin.buildModelFromUrdf(urdf)
        geometry = pin.buildGeomFromUrdf(
            self._model, urdf, pin.GeometryType.COLLISION, package_dirs=packages
        )
        parts = {name: geometry.getGeometryId(f"{name}_0") for name in URDF_LINKS}
        links = [parts[name] for name in URDF_LINKS]
        tool0 = self._model.frames[self._model.getFrameId("tool0")]
        mounts: list[int] = []
        boxes: list[int] = []
        for k, body in enumerate(bodies_of(arm_of(UR5), mount, cell)):
            if body.role == "link":
                continue
            at = (
                tool0.placement * pin.SE3(body.shape.T_frame_shape)
                if body.role == "mount"
                else pin.SE3(BASE_LINK_FROM_BASE @ body.shape.T_frame_shape)
            )
            joint = tool0.parentJoint if body.role == "mount" else 0
            shape = coal_shape(body.shape)
            added = geometry.addGeometryObject(pin.GeometryObject(f"{k}", joint, at, shape))
            (mounts if body.role == "mount" else boxes).append(added)
        pairs = [(i, j) for (a, i), (b, j) in combinations(enumerate(links), 2) if b - a > 1]
        pairs += [(i, j) for i in links[:-1] for j in mounts]
        pairs += [(i, j) for i in (*links[1:], *mounts) for j in boxes]
        geometry.removeAllCollisionPairs()
        for i, j in pairs:
            geometry.addCollisionPair(pin.CollisionPair(i, j))
        self._geometry, self._links = geometry, links
        self._data, self._work = self._model.createData(), geometry.createData()
        # Triangle trees know no covered shapes: the mount's cover is a margin of its pairs.
        for (i, j), request in zip(pairs, self._work.collisionRequests, strict=True):
            request.security_margin = mount.cover_m if i in mounts or j in mounts else 0.0

    def touches(self, joints: ArrayLike) -> Mask:
        """Return (N,) whether any two parts touch at joints (N, 6)."""
        pin = import_pinocchio()

        rows = np.ascontiguousarray(joints, dtype=np.float64)
        model, data, geometry, work = self._model, self._data, self._geometry, self._work
        return np.array(
            [pin.computeCollisions(model, data, geometry, work, q, True) for q in rows], dtype=bool
        )

    def triangles(self, joints: ArrayLike) -> dict[str, Array]:
        """Return each link's triangles (T, 3, 3) in the controller's base at joints (6,) [m]."""
        pin = import_pinocchio()

        q = np.ascontiguousarray(joints, dtype=np.float64)
        pin.updateGeometryPlacements(self._model, self._data, self._geometry, self._work, q)
        found: dict[str, Array] = {}
        for name, k in zip(arm_of(UR5).link_names, self._links, strict=True):
            mesh = self._geometry.geometryObjects[k].geometry
            corners = np.array([mesh.vertex(i) for i in range(mesh.num_vertices)])
            faces = np.array(
                [[t[0], t[1], t[2]] for t in (mesh.tri_indices(i) for i in range(mesh.num_tris))]
            )
            T = BASE_LINK_FROM_BASE @ self._work.oMg[k].homogeneous
            found[name] = (corners @ T[:3, :3].T + T[:3, 3])[faces]
        return found


def compare_with_meshes(
    mount: Mount, cell: WorkCell, n: int = 4000, seed: int = 0
) -> dict[str, float]:
    """Return how our shapes judge n random joint vectors, compared with the UR5's meshes.

    `unsafe_share`: free by ours while meshes touch; `overcautious_share`: not free by ours while
    the meshes are free; `mesh_colliding_share`: meshes touch. All are shares of all n.

    Raises:
        MissingLibraryError: `example-robot-data` is not installed.
    """
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (n, 6))
    free = CollisionModel(UR5, mount, cell, 0.0).free(q)
    touches = MeshModel(mount, cell).touches(q)
    return {
        "unsafe_share": float(np.mean(free & touches)),
        "overcautious_share": float(np.mean(~free & ~touches)),
        "mesh_colliding_share": float(np.mean(touches)),
    }
