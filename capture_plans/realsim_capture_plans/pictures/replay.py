"""A plan driven in the browser: a time slider over the tour, the arm, and what it comes near to."""

import contextlib
import io
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from realsim import local_pages
from realsim.arrays import Array, UInt8
from realsim.geometry import se3
from realsim.interop import viser_wxyz_position
from realsim.robots.shapes import Box
from realsim.store.atomic import write_text
from realsim_capture_plans.collision.model import CollisionModel
from realsim_capture_plans.pictures.arm_chart import (
    Part,
    arm_looks,
    arm_parts,
    box_edges,
    camera_parts,
    frustum_lines,
    part_frames,
)
from realsim_capture_plans.pictures.motion_charts import GROUP_LABELS
from realsim_capture_plans.planning.record import CapturePlan
from realsim_capture_plans.planning.tour_time import TourTime
from realsim_capture_plans.planning.view_quality import Sensor, scene_box, sensor_of

SPEEDS = {"1 x": 1.0, "2 x": 2.0, "5 x": 5.0, "10 x": 10.0, "30 x": 30.0}
FRAME_S = 1 / 25
"""Between two drawn positions while playing [s]."""
SLIDER_STEP_S = 0.01
"""The slider's step [s]: 1 cm of camera path at full speed."""
FILE_FRAME_S = 1 / 20
"""Between two recorded positions of a file [s]."""
FILE_LONGEST_S = 90.0
"""A file's replay takes no longer than this [s]: longer tours are driven faster."""
FILE_SPEED = 3.0
"""How many times faster than the arm a file's replay is, at least."""


class PlanReplay:
    """One plan's replay; it runs in threads of its own until `stop`."""

    def __init__(
        self, plan: CapturePlan, *, host: str = "127.0.0.1", port: int = 8080, looks: bool = True
    ) -> None:
        """Listen, and build scene and panel; returns when both are there.

        Args:
            plan: what is shown.
            host: where to listen.
            port: the next free one is taken if it is in use, 0 = any.
            looks: whether to draw the arm as it looks, where the extra `looks` is installed.

        Raises:
            InputError: the host is reachable from other machines, or the
                plan's camera is not known.
        """
        import viser

        self.plan = plan
        self.tour = TourTime.of(plan)
        self.model: CollisionModel = plan.collision_model()
        sensor = sensor_of(plan)
        self._host = local_pages.check_host(host, "the replay")
        # Viser prints a banner with its address; the caller says what is to be said.
        with local_pages.guarded(local_pages.Door()), contextlib.redirect_stdout(io.StringIO()):
            self.server = viser.ViserServer(
                host=host, port=port, label="realsim plan", verbose=False
            )
        local_pages.refuse_foreign_messages(self.server)
        self.scene = ReplayScene(self.server, plan, sensor, looks)
        self.time_s = 0.0
        self._stopping = threading.Event()
        self._drawing = threading.RLock()
        self._build_panel()
        self.show(0.0)
        self._player = threading.Thread(target=self._play, name="replay", daemon=True)
        self._player.start()

    @property
    def url(self) -> str:
        """The address to open in a browser."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"http://{host}:{self.server.get_port()}"

    def stop(self) -> None:
        """Stop playing and listening."""
        self._stopping.set()
        self._player.join()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def show(self, time_s: float) -> None:
        """Draw the arm where it is at a time of the tour [s], with its clearances."""
        with self._drawing:
            self.time_s = float(np.clip(time_s, 0.0, self.tour.total_s))
            joints = self.tour.joints_at(self.time_s)
            with self.server.atomic():
                self.scene.pose(joints)
                self.scene.mark(near_parts(self.model, joints))
            self._slider.value = round(self.time_s / SLIDER_STEP_S) * SLIDER_STEP_S
            self._view.value = int(self.tour.move[self.tour.leg_at(self.time_s)])
            self._text.content = self.describe(self.time_s)

    def show_view(self, view: int) -> None:
        """Draw the arm at a view."""
        self.show(float(self.tour.view_s[int(np.clip(view, 0, len(self.plan) - 1))]))

    def describe(self, time_s: float) -> str:
        """Return in Markdown where the arm is at a time [s] and what it is near to."""
        tour, need = self.tour, self.model.clearance_m
        move = int(tour.move[tour.leg_at(time_s)])
        arrived = time_s >= tour.view_s[move]
        where = f"**at view {move}**" if arrived else f"on the move to **view {move}**"
        lines = [f"{time_s:.1f} of {tour.total_s:.1f} s, {where} of {len(self.plan)}", ""]
        lines += ["| clearance | mm |", "|:--|--:|"]
        joints = tour.joints_at(time_s)
        found = self.model.clearance(joints[None])
        for group, distance in found.items():
            d = float(distance[0])
            if np.isfinite(d):
                text = f"{1000 * d:.1f}" if d >= need else f"**{1000 * d:.1f} TOO NEAR**"
                lines.append(f"| {GROUP_LABELS.get(group, group).replace(chr(10), ' ')} | {text} |")
        _, first, second, _ = self.model.nearest(joints)
        lines.append(f"\nnearest: {first} and {second}  ")
        lines.append(f"required: {1000 * need:g} mm; what is nearest is red where it is too near")
        return "\n".join(lines)

    # --- panel ------------------------------------------------------------------------------

    def _build_panel(self) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self._text = gui.add_markdown("")
        self._slider: Any = gui.add_slider(
            "Time [s]", 0.0, float(np.ceil(self.tour.total_s)), SLIDER_STEP_S, 0.0
        )
        self._playing = gui.add_checkbox("Play", False)
        self._speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="5 x")
        self._view: Any = gui.add_number("View", 0, min=0, max=len(self.plan) - 1, step=1)
        steps = gui.add_button_group("Step", ("previous view", "next view"))
        first, last = "#440154", "#fde725"
        gui.add_markdown(
            f"{len(self.plan)} {self.plan.kind} views of a {self.plan.robot}, "
            f"{self.plan.mount.name}. Small frustums: the views in their order, from "
            f"<span style='color:{first}'>dark</span> to "
            f"<span style='color:{last}'>yellow</span>. Orange box: only objects may be there."
        )
        self._slider.on_update(self._slider_moved)
        self._view.on_update(self._view_typed)
        steps.on_click(lambda event: self._step(1 if steps.value == "next view" else -1))

    def _step(self, by: int) -> None:
        """Go to the view before or after the place on the tour."""
        arrived = np.searchsorted(self.tour.view_s, self.time_s + 1e-6, side="right") - 1
        at_view = arrived >= 0 and self.time_s < self.tour.view_s[arrived] + 1e-3
        self.show_view(int(arrived) + (by if by > 0 or at_view else 0))

    def _slider_moved(self, event: Any) -> None:
        if event.client is not None:  # moved by a person, not by `show`
            self.show(float(self._slider.value))

    def _view_typed(self, event: Any) -> None:
        if event.client is not None:
            self.show_view(int(self._view.value))

    def _play(self) -> None:
        """Go on with the time while the box is ticked; from the end, begin again."""
        last = time.monotonic()
        while not self._stopping.wait(FRAME_S):
            now = time.monotonic()
            passed, last = now - last, now
            if not self._playing.value:
                continue
            at_end = self.time_s >= self.tour.total_s
            self.show(0.0 if at_end else self.time_s + passed * SPEEDS[self._speed.value])


def near_parts(model: CollisionModel, joints: Array) -> set[str]:
    """Return the names of the nearest pair of parts, if it is nearer than the plan's clearance."""
    _, first, second, distance = model.nearest(joints)
    return {first, second} if distance < model.clearance_m else set()


def write_replay(plan: CapturePlan, path: Path | str, *, looks: bool = True) -> Path:
    """Write the replay as one HTML file that plays in any browser, without a server or a network.

    It has no panel: viser's player has its own slider and speed. Tours are driven at least
    `FILE_SPEED` times faster than the arm goes.

    Args:
        plan: what is shown.
        path: the .html file; written whole or not at all.
        looks: whether to draw the arm as it looks, where the extra `looks` is installed.

    Raises:
        InputError: the plan's camera is not known.
    """
    replay = PlanReplay(plan, port=0, looks=looks)
    try:
        serializer = replay.server.get_scene_serializer()
        faster = max(FILE_SPEED, replay.tour.total_s / FILE_LONGEST_S)
        for t in np.arange(0.0, replay.tour.total_s, FILE_FRAME_S * faster):
            joints = replay.tour.joints_at(t)
            replay.scene.pose(joints)
            replay.scene.mark(near_parts(replay.model, joints))
            serializer.insert_sleep(FILE_FRAME_S)
        page = serializer.as_html()
    finally:
        replay.stop()
    write_text(path, page)
    return Path(path)


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
        links = range(plan.chain.joints + 1)
        self._frames = [self._scene.add_frame(f"/arm/{i}", show_axes=False) for i in links]
        self.parts: dict[str, list[tuple[Any, tuple[int, int, int]]]] = {}
        outside = arm_looks(plan) if looks else None
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
        """Move the arm to joints (n,) [rad]."""
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


def order_rgb(n: int) -> UInt8:
    """Return n colours (n, 3) from the first view (dark blue) to the last (yellow)."""
    from matplotlib import colormaps

    rgba = colormaps["viridis"](np.linspace(0.0, 1.0, n))
    return np.round(255 * np.asarray(rgba)[:, :3]).astype(np.uint8)
