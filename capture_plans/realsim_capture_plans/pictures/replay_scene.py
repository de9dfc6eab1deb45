"""The replay's scene as viser nodes: arm, camera, table, boxes, every view."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.interop import viser_wxyz_position
from realsim_capture_plans.collision.shapes import Box
from realsim_capture_plans.pictures.arm_chart import box_edges, frustum_lines
from realsim_capture_plans.pictures.arm_looks import (
    Part,
    arm_parts,
    camera_parts,
    part_frames,
    ur5_looks,
)
from realsim_capture_plans.planning.record import CapturePlan
from realsim_capture_plans.planning.view_quality import Sensor, scene_box

Array = NDArray[np.float64]
ARM_RGB, CAMERA_RGB, NEAR_RGB = (186, 190, 196), (60, 64, 72), (213, 60, 0)
TABLE_RGB, KEEP_OUT_RGB, OBSTACLE_RGB = (222, 216, 205), (230, 159, 0), (204, 121, 167)
VIEW_FRUSTUM_M = 0.018
"""Length of the frustum of a view [m]; 256 of 2 cm leave the arm to be seen."""
CAMERA_FRUSTUM_M = 0.08
"""Length of the frustum that moves with the arm [m]."""
TABLE_DEPTH_M = 0.02
"""Drawn thickness of the table [m]."""
LOOK_FROM_M, LOOK_AT_M = (0.40, -0.72, 0.42), (-0.12, 0.0, 0.10)
"""A new browser's camera and what it looks at, from the scene's centre [m]."""
DRAWN_REACH_M = 1.0
"""Nothing is drawn farther than this from the base [m]."""
LINE_M, THIN_LINE_M = 0.003, 0.0008
"""Thickness of the boxes' edges and of the views' frustums [m]."""


class ReplayScene:
    """The nodes of one plan in a viser server; `pose` moves the arm, `mark` colours it."""

    def __init__(self, server: Any, plan: CapturePlan, sensor: Sensor, looks: bool) -> None:
        """Add everything, with the arm at home.

        Args:
            server: a viser.ViserServer.
            plan: what is shown.
            sensor: the camera's field of view.
            looks: whether to draw the arm as it looks, where the meshes are installed.
        """
        self._scene = server.scene
        self._plan = plan
        self._frames = [self._scene.add_frame(f"/arm/{i}", show_axes=False) for i in range(7)]
        self.parts: dict[str, list[tuple[Any, tuple[int, int, int]]]] = {}
        outside = ur5_looks(plan) if looks else None
        self.looks_drawn = outside is not None
        bodies = arm_parts(plan) if outside is None else [*outside, *camera_parts(plan)]
        for k, part in enumerate(bodies):
            self._add_part(k, part, smooth=self.looks_drawn)
        self._add_cell()
        self._add_cameras(sensor)
        self.pose(plan.home)
        server.scene.set_up_direction("+z")
        centre = plan.center_world
        server.initial_camera.position = tuple(centre + np.array(LOOK_FROM_M))
        server.initial_camera.look_at = tuple(centre + np.array(LOOK_AT_M))

    def pose(self, joints: Array) -> None:
        """Move the arm to joints (6,) [rad]."""
        for frame, T in zip(self._frames, part_frames(self._plan, joints), strict=True):
            frame.wxyz, frame.position = viser_wxyz_position(T)

    def mark(self, near: set[str]) -> None:
        """Draw the parts of these names red, all others in their own colour."""
        for name, drawn in self.parts.items():
            for node, color in drawn:
                wanted = NEAR_RGB if name in near else color
                if tuple(node.color) != wanted:
                    node.color = wanted

    def _add_part(self, number: int, part: Part, smooth: bool) -> None:
        on_flange = part.name in {p.name for p in camera_parts(self._plan)}
        color = CAMERA_RGB if on_flange else ARM_RGB
        node = self._scene.add_mesh_simple(
            f"/arm/{part.frame}/{number} {part.name}",
            part.vertices.astype(np.float32),
            part.faces.astype(np.uint32),
            color=color,
            flat_shading=not smooth or on_flange,
            side="double",
        )
        self.parts.setdefault(part.name, []).append((node, color))

    def _add_cell(self) -> None:
        """Add the table, the keep-out box and the obstacles."""
        cell = self._plan.cell
        low = np.clip(cell.table.lower, -DRAWN_REACH_M, DRAWN_REACH_M)
        high = np.clip(cell.table.upper, -DRAWN_REACH_M, DRAWN_REACH_M)
        low[2] = max(low[2], high[2] - TABLE_DEPTH_M)
        self._scene.add_box(
            "/table", dimensions=tuple(high - low), position=tuple((low + high) / 2),
            color=TABLE_RGB, cast_shadow=False,
        )  # fmt: skip
        self._add_edges("/keep-out box", scene_box(self._plan), KEEP_OUT_RGB)
        for name, box in cell.obstacles:
            self._add_edges(f"/obstacles/{name}", box, OBSTACLE_RGB)

    def _add_edges(self, name: str, box: Box, color: tuple[int, int, int]) -> None:
        self._scene.add_line_segments(
            name, box_edges(box).astype(np.float32), color, thickness=LINE_M
        )

    def _add_cameras(self, sensor: Sensor) -> None:
        """Add every view's frustum, coloured by its order, and the one in the hand."""
        Ts = self._plan.Ts_base_cam
        lines = frustum_lines(Ts, sensor.intrinsics, VIEW_FRUSTUM_M)
        colors = np.repeat(order_rgb(len(Ts)), len(lines) // len(Ts), axis=0)
        self._scene.add_line_segments(
            "/views", lines.astype(np.float32),
            np.broadcast_to(colors[:, None], lines.shape).astype(np.uint8), thickness=THIN_LINE_M,
        )  # fmt: skip
        own = frustum_lines(np.eye(4)[None], sensor.intrinsics, CAMERA_FRUSTUM_M)
        in_flange = se3.transform(self._plan.mount.T_ee_cam, own.reshape(-1, 3)).reshape(own.shape)
        self._scene.add_line_segments(
            "/arm/6/field of view", in_flange.astype(np.float32), CAMERA_RGB, thickness=LINE_M / 2
        )


def order_rgb(n: int) -> NDArray[np.uint8]:
    """Return n colours (n, 3) from the first view (dark blue) to the last (yellow)."""
    from matplotlib import colormaps

    rgba = colormaps["viridis"](np.linspace(0.0, 1.0, n))
    return np.round(255 * np.asarray(rgba)[:, :3]).astype(np.uint8)
