"""Meshes of the arm, its camera and its mount, for drawing only: each fixed in one DH frame."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import MissingLibraryError, RealsimError
from realsim.geometry import se3
from realsim.geometry.mesh_files import load_mesh
from realsim.geometry.mesh_shape import hull_triangles
from realsim.interop import import_pinocchio, unbroken
from realsim.robots.arm import arm_of
from realsim.robots.link_shapes import LARGEST_MM_SCALE, link_placements, link_shape
from realsim.robots.shapes import Shape
from realsim.robots.urdf import UrdfShape
from realsim_capture_plans.collision.mount import camera_shape
from realsim_capture_plans.collision.ur5_meshes import BASE_LINK_FROM_BASE, URDF, robots_folder
from realsim_capture_plans.planning.record import CapturePlan

ROUND_SIDES = 24
"""Sides that a drawn cylinder has."""
ROUND_RINGS = 5
"""Rings of vertices on each of a capsule's caps."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Part:
    """One drawn piece of the arm."""

    name: str
    """What it is: 'forearm', 'camera'."""
    frame: int
    """The frame of `part_frames` that it is fixed in."""
    vertices: Array
    """(V, 3) in that frame [m]."""
    faces: Int64
    """(F, 3) corners of triangles, counter-clockwise from outside."""


def part_frames(plan: CapturePlan, joints: Array) -> Array:
    """Return where the drawn links are (..., n + 1, 4, 4) [m] at joints (..., n) [rad]."""
    return plan.chain.link_frames(joints) @ link_placements(arm_of(plan.chain))


def arm_parts(plan: CapturePlan) -> list[Part]:
    """Return the shapes that collisions are computed with: arm, camera, bracket.

    Raises:
        InputError: there are no shapes for this arm.
    """
    return [*map(_part, arm_of(plan.chain).shapes), *camera_parts(plan)]


def camera_parts(plan: CapturePlan) -> list[Part]:
    """Return what is fixed to the flange: camera and bracket."""
    flange = plan.chain.joints
    return [
        _part(replace(shape, frame=flange))
        for shape in (camera_shape(plan.mount), *plan.mount.bracket)
    ]


def _part(shape: Shape) -> Part:
    vertices, faces = shape_mesh(shape)
    return Part(
        name=shape.part,
        frame=shape.frame,
        vertices=se3.transform(shape.T_frame_shape, vertices),
        faces=faces,
    )


def shape_mesh(shape: Shape) -> tuple[Array, Int64]:
    """Return vertices (V, 3) [m] in the shape's own frame and triangles (F, 3).

    Every shape is convex: its mesh is the hull of points on it. Round ones are drawn a little
    inside themselves, by at most 1 % of their radius.
    """
    if shape.kind == "box":
        bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
        points = np.asarray((bits - 0.5) * np.array(shape.size_m), dtype=np.float64)
    elif shape.points is not None:
        points = np.asarray(shape.points)
    else:
        points = _round_points(shape)
    return hull_triangles(points)


def _round_points(shape: Shape) -> Array:
    """Return points on a sphere, cylinder or capsule."""
    radius = shape.size_m[0]
    half = shape.size_m[1] / 2 if len(shape.size_m) > 1 else 0.0
    around = np.arange(ROUND_SIDES) * (2 * np.pi / ROUND_SIDES)
    circle = np.stack([np.cos(around), np.sin(around), np.zeros(ROUND_SIDES)], -1)
    up = np.array([0.0, 0.0, 1.0])
    if shape.kind == "cylinder":
        return np.concatenate([radius * circle + half * up, radius * circle - half * up])
    tilt = np.linspace(0.0, np.pi / 2, ROUND_RINGS)[:, None, None]
    cap = (radius * (np.cos(tilt) * circle + np.sin(tilt) * up) + half * up).reshape(-1, 3)
    return np.concatenate([cap, cap * [1.0, 1.0, -1.0]])


def arm_looks(plan: CapturePlan) -> list[Part] | None:
    """Return the arm's own outside for its collision shapes; None where it cannot be had."""
    arm = arm_of(plan.chain)
    if not arm.looks:
        return _ur5_looks(plan)
    try:
        return [
            Part(name=arm.link_names[link], frame=link, vertices=vertices, faces=faces)
            for link, shape in arm.looks
            for vertices, faces in [_look(shape)]
        ]
    except RealsimError:
        return None


def _look(shape: UrdfShape) -> tuple[Array, Int64]:
    """Return vertices (V, 3) in the link's frame [m] and triangles (F, 3) of a URDF's shape."""
    if shape.file is None:
        body = link_shape(shape, shape.link, 0, np.eye(4))
        vertices, faces = shape_mesh(body)
        return se3.transform(body.T_frame_shape, vertices), faces
    millimetres = np.abs(shape.size_m).max() < LARGEST_MM_SCALE
    mesh = load_mesh(shape.file, "mm" if millimetres else "m", [])
    vertices = mesh.vertices * np.array(shape.size_m) * (1e3 if millimetres else 1.0)
    return se3.transform(shape.T_link_shape, vertices), mesh.faces.astype(np.int64)


def _ur5_looks(plan: CapturePlan) -> list[Part] | None:
    """Return the UR5's outside as example-robot-data has it; None of other arms and without it.

    The meshes stand in ROS's `base_link`, which is turned by 180 deg about z against the
    controller's base; where each is in our links follows from both kinematics at zero.
    """
    if plan.chain.name != "UR5":
        return None
    try:
        folder = robots_folder()
    except MissingLibraryError:
        return None
    pin = import_pinocchio()
    import trimesh

    urdf = str(folder / URDF)
    model = pin.buildModelFromUrdf(urdf)
    visual = pin.buildGeomFromUrdf(
        model, urdf, pin.GeometryType.VISUAL, package_dirs=[str(folder.parent.parent)]
    )
    data = model.createData()
    pin.forwardKinematics(model, data, np.zeros(plan.chain.joints))
    # The nominal links are where the drawn links of a calibrated arm are, too.
    T_link_base = se3.invert(plan.chain.nominal().link_frames(np.zeros(plan.chain.joints)))
    parts: list[Part] = []
    for one in visual.geometryObjects:
        frame = int(one.parentJoint)
        T_ros_mesh = (data.oMi[frame] * one.placement).homogeneous
        with unbroken():
            mesh: Any = trimesh.load_mesh(one.meshPath)
        T_link_mesh = T_link_base[frame] @ BASE_LINK_FROM_BASE @ T_ros_mesh
        parts.append(
            Part(
                name=arm_of(plan.chain).link_names[frame],
                frame=frame,
                vertices=se3.transform(T_link_mesh, np.asarray(mesh.vertices, dtype=np.float64)),
                faces=np.asarray(mesh.faces, dtype=np.int64),
            )
        )
    return parts
