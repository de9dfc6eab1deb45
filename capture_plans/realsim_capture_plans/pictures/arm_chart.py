"""The arm at a few views: in space, from above and from the side.

Meshes of the arm, its camera and its mount, for drawing only: each fixed in one DH frame.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import MissingLibraryError, RealsimError
from realsim.geometry import se3
from realsim.geometry.mesh_files import load_mesh
from realsim.geometry.mesh_shape import hull_triangles
from realsim.interop import import_pinocchio, unbroken
from realsim.records import CameraIntrinsics
from realsim.robots.arm import arm_of
from realsim.robots.shapes import LARGEST_MM_SCALE, Box, Shape, link_placements, link_shape
from realsim.robots.urdf import UrdfShape
from realsim_capture_plans.collision.mount import camera_shape
from realsim_capture_plans.collision.ur5_meshes import BASE_LINK_FROM_BASE, URDF, robots_folder
from realsim_capture_plans.pictures import drawing
from realsim_capture_plans.planning.record import CapturePlan
from realsim_capture_plans.planning.view_quality import scene_box
from realsim_capture_plans.planning.viewpoints import farthest_points

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


ARMS_SHOWN = 3
"""Arms drawn, those whose cameras are farthest apart; more hide each other."""
ARM_COLORS = (drawing.BLUE, drawing.GREEN, drawing.PURPLE)
LIGHT = np.array([0.3, -0.5, 0.81])
"""Where the drawn bodies are lit from, in base; about a unit vector."""
LONGEST_EDGE_M = 0.10
"""Longer edges of drawn triangles are halved [m]."""
FRUSTUM_M = 0.05
"""Length of the drawn frustums of the views that arms are drawn at [m]."""
SMALL_FRUSTUM_M = 0.018
"""Length of all other views' frustums [m]."""
DRAWN_REACH_M = 1.0
"""The table is drawn no farther than this from the base [m]."""


def arm_chart(curves: drawing.PlanCurves) -> Any:
    """Return the figure: the arm, cameras, table and keep-out box, three ways."""
    figure = drawing.new_figure(13.0, 7.6)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.55, 1])
    draw_arm(figure.add_subplot(grid[:, 0], projection="3d"), curves)
    _draw_flat(figure.add_subplot(grid[0, 1]), curves, (0, 1), "from above")
    _draw_flat(figure.add_subplot(grid[1, 1]), curves, (0, 2), "from the side")
    handles, labels = figure.axes[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=9, frameon=False)
    figure.suptitle(
        f"{curves.plan.robot} at {len(_shown(curves))} of {len(curves.plan)} views, "
        f"{curves.plan.mount.name}",
        fontsize=12,
    )
    return figure


def draw_arm(axes: Any, curves: drawing.PlanCurves) -> None:
    """Draw the scene in space on a 3-D axes."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
    from trimesh.remesh import subdivide_to_size

    plan, camera = curves.plan, curves.sensor.intrinsics
    # The order is given: matplotlib would guess it, and draw the table over the arm.
    axes.computed_zorder = False
    for box, color in [
        (scene_box(plan), drawing.ORANGE),
        *((b, drawing.RED) for _, b in plan.cell.obstacles),
    ]:
        lines = Line3DCollection(box_edges(box), colors=color, linewidths=1.6, zorder=2)
        axes.add_collection3d(lines)
    small = frustum_lines(plan.Ts_base_cam, camera, SMALL_FRUSTUM_M)
    axes.add_collection3d(Line3DCollection(small, colors="0.45", linewidths=0.5, zorder=1))
    everything = [plan.Ts_base_cam[:, :3, 3], np.zeros((1, 3))]
    triangles: list[Array] = []
    colors: list[Array] = []
    for k, color in zip(_shown(curves), ARM_COLORS, strict=False):
        for vertices, faces in _posed(curves, k):
            # Triangles are sorted by their middles; long ones would be drawn over what is before.
            cut: Any = subdivide_to_size(vertices, faces, LONGEST_EDGE_M)
            corner: Array = cut[0][cut[1]]
            triangles.append(corner)
            colors.append(_shaded(corner, color))
            everything.append(vertices)
        near = frustum_lines(plan.Ts_base_cam[k : k + 1], camera, FRUSTUM_M)
        axes.add_collection3d(Line3DCollection(near, colors=color, linewidths=1.6, zorder=4))
    # One collection, so that triangles are sorted among each other.
    axes.add_collection3d(
        Poly3DCollection(np.concatenate(triangles), facecolors=np.concatenate(colors), zorder=3)
    )
    points = np.concatenate(everything)
    low, high = points.min(axis=0) - 0.03, points.max(axis=0) + 0.03
    table = _table_corners(plan.cell.table, low, high)
    if table is not None:
        axes.add_collection3d(
            Poly3DCollection([table], facecolors="0.92", edgecolors="0.6", zorder=0)
        )
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.1)
    axes.view_init(elev=24, azim=-55)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.tick_params(labelsize=8)


def _draw_flat(axes: Any, curves: drawing.PlanCurves, plane: tuple[int, int], title: str) -> None:
    """Draw the scene projected on two of base's axes."""
    from matplotlib.collections import LineCollection, PolyCollection
    from scipy.spatial import ConvexHull

    plan, (a, b) = curves.plan, plane
    reach = np.full(3, DRAWN_REACH_M)
    table = _table_corners(plan.cell.table, -reach, reach)
    if table is not None:
        axes.fill(table[:, a], table[:, b], facecolor="0.93", edgecolor="0.6", label="table")
    for k, color in zip(_shown(curves), ARM_COLORS, strict=False):
        # A convex body's outline is the hull of its corners.
        flat = [vertices[:, [a, b]] for vertices, _ in _posed(curves, k)]
        outlines = [points[ConvexHull(points).vertices] for points in flat]
        axes.add_collection(PolyCollection(outlines, facecolors=color, edgecolors="white",
                            linewidths=0.4, alpha=0.75, label=f"arm at view {k}"))  # fmt: skip

    def draw(lines: Array, color: str, width: float, label: str | None) -> None:
        flat = list(lines[..., [a, b]])
        axes.add_collection(LineCollection(flat, colors=color, linewidths=width, label=label))

    small = frustum_lines(plan.Ts_base_cam, curves.sensor.intrinsics, SMALL_FRUSTUM_M)
    draw(small, "0.3", 0.4, "every view's camera")
    draw(box_edges(scene_box(plan)), drawing.ORANGE, 1.8, "keep-out box")
    for k, (_, obstacle) in enumerate(plan.cell.obstacles):
        draw(box_edges(obstacle), drawing.RED, 1.5, "obstacle" if k == 0 else None)
    axes.autoscale_view()
    axes.set_aspect("equal")
    axes.set_xlabel(f"{'xyz'[a]} [m]")
    axes.set_ylabel(f"{'xyz'[b]} [m]")
    axes.set_title(title, fontsize=10)
    drawing.plain(axes)


def _shown(curves: drawing.PlanCurves) -> list[int]:
    """Return the views that arms are drawn at: the topmost and those farthest from it."""
    n = min(ARMS_SHOWN, len(curves.plan))
    places = curves.plan.Ts_base_cam[:, :3, 3]
    return sorted(int(k) for k in farthest_points(places, n, curves.plan.reference_view))


def _posed(curves: drawing.PlanCurves, view: int) -> list[tuple[Array, Int64]]:
    """Return vertices (V, 3) in base [m] and triangles of every body of the arm at a view."""
    frames = part_frames(curves.plan, curves.plan.joints[view])
    return [(se3.transform(frames[p.frame], p.vertices), p.faces) for p in arm_parts(curves.plan)]


def _shaded(triangles: Array, color: str) -> Array:
    """Return one colour (F, 4) per triangle (F, 3, 3), darker where it is turned from the light."""
    from matplotlib.colors import to_rgb

    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    toward = (normal / np.where(length > 0, length, 1.0)) @ LIGHT
    rgb = (0.7 + 0.3 * toward)[:, None] * np.array(to_rgb(color)) * 0.85 + 0.12
    return np.concatenate([np.clip(rgb, 0.0, 1.0), np.ones((len(rgb), 1))], axis=1)


def _table_corners(box: Box, low: Array, high: Array) -> Array | None:
    """Return the corners (4, 3) of the table's top inside bounds (3,); None = endless."""
    top = box.upper[2]
    if not np.isfinite(top):
        return None
    x = np.clip([box.lower[0], box.upper[0]], low[0], high[0])
    y = np.clip([box.lower[1], box.upper[1]], low[1], high[1])
    corners = [[x[0], y[0], top], [x[1], y[0], top], [x[1], y[1], top], [x[0], y[1], top]]
    return np.array(corners, dtype=np.float64)


def box_edges(box: Box) -> Array:
    """Return the twelve edges (12, 2, 3) of a box, cut off far from the base."""
    low, high = np.clip([box.lower, box.upper], -DRAWN_REACH_M, DRAWN_REACH_M)
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    corners = np.where(bits == 1, high, low)
    pairs = [(i, i | 1 << k) for i in range(8) for k in range(3) if not i & 1 << k]
    return corners[np.array(pairs)]


def frustum_lines(Ts_base_cam: Array, camera: CameraIntrinsics, length_m: float) -> Array:
    """Return the lines (N * 8, 2, 3) of the pyramids of a length [m] that cameras (N, 4, 4) see."""
    c = camera
    x, y = c.width / 2 / c.fx * length_m, c.height / 2 / c.fy * length_m
    z = length_m
    points = np.array([[0, 0, 0], [-x, -y, z], [x, -y, z], [x, y, z], [-x, y, z]])
    world = se3.transform(Ts_base_cam, points)
    pairs = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])
    return world[:, pairs].reshape(-1, 2, 3)
