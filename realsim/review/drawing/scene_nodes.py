"""The review's scene in one browser: meshes, cloud, cameras, table and grasps as viser nodes.

Every object is a frame with its meshes, its box and its ellipsoid below it, so that an object moves
by one message; all cameras and all pieces of the cloud stand below one frame each, so that they are
switched by one message. What is rarely looked at is sent when it is first asked for.

Grasps in a browser: thousands of grippers as one batched mesh, and which of them is clicked.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
import viser

from realsim.arrays import Array, Array32, Rows
from realsim.errors import InputError
from realsim.interop import viser_wxyz_position
from realsim.records import GraspSet, View
from realsim.rendering.overlay import VERDICT_RGB, grasp_rgb
from realsim.review.content.config import SceneConfig
from realsim.review.content.content import SceneContent
from realsim.review.drawing.cloud_nodes import CloudNodes
from realsim.review.drawing.grasp_drawing import (
    GraspFilter,
    chosen_grasps,
    gripper_mesh,
    gripper_scales,
    linear_rgb,
)
from realsim.review.placing.ellipsoid import Ellipsoid, unit_sphere

NAME = "/grasps"


class GraspNodes:
    """The grasps drawn in one scene."""

    def __init__(self, api: viser.SceneApi) -> None:
        """Draw nothing yet."""
        self._api = api
        self._node: viser.BatchedMeshHandle | None = None
        self.drawn: list[tuple[int, int]] = []
        """Instance and row of every gripper, in the order of the batch."""
        self._on_click: Callable[[int, int], None] = lambda instance, row: None

    def draw(
        self, found: Sequence[tuple[GraspSet, Rows]], Ts_world_obj: Mapping[int, Array]
    ) -> int:
        """Draw these rows of these sets instead of those before; return how many."""
        self.clear()
        if not found:
            return 0
        Ts = [Ts_world_obj[g.instance] @ g.Ts_obj_grasp[rows] for g, rows in found]
        wxyzs, positions = viser_wxyz_position(np.concatenate(Ts))
        widths = np.concatenate([g.widths_m[rows] for g, rows in found])
        rgb = np.concatenate([grasp_rgb(g, rows) for g, rows in found])
        vertices, faces = gripper_mesh()
        self.drawn = [(g.instance, int(row)) for g, rows in found for row in rows]
        # Off: of two dozen triangles nothing can be left out.
        self._node = self._api.add_batched_meshes_simple(
            NAME, vertices, faces, wxyzs, positions, batched_scales=gripper_scales(widths),
            batched_colors=linear_rgb(rgb), lod="off", flat_shading=True,
            side="double", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        drawn = self.drawn

        def clicked(event: Any) -> None:
            index = event.instance_index
            if index is not None and 0 <= index < len(drawn):
                self._on_click(*drawn[index])

        self._node.on_click(clicked)
        return len(self.drawn)

    def on_click(self, callback: Callable[[int, int], None]) -> None:
        """Call back with instance and row of a grasp that is clicked."""
        self._on_click = callback

    def clear(self) -> None:
        """Draw none."""
        if self._node is not None:
            self._node.remove()
            self._node = None
        self.drawn = []


__all__ = ["GraspFilter", "SceneConfig", "SceneNodes"]

Look = Literal["appearance", "verdict", "faded", "hidden"]
OnInstance = Callable[[int], None]
FRUSTUM_RGB, DAMAGED_RGB = (70, 96, 140), (190, 190, 190)
"""Colours of a camera, and of one whose images cannot be read."""
HIGHLIGHT_RGB = (255, 120, 0)
ELLIPSOID_RGB = (130, 80, 220)
FADED_RGB, FADED = (150, 155, 165), 0.3
"""Colour and opacity of faded models: measured points inside them are seen."""
BOX_MARGIN_M = 0.004
"""The box about a highlighted object keeps so far off it [m], not to be lost in its faces."""
SIGHT_SHARE, SIGHT_COS = 0.7, 0.8
"""Share of the line of sight, and cosine of the angle about it, in which a frustum is hidden."""
SKY, GROUND_RGB = 4.0, (77, 77, 77)
"""Light of the sky, and colour of the light from below."""
FRUSTUM_LINE_M = 0.001
"""Thickness of a frustum's lines [m]."""


class SceneNodes:
    """The nodes of one scene in one browser, or in all browsers of a server."""

    def __init__(self, api: viser.SceneApi, content: SceneContent, config: SceneConfig) -> None:
        """Start with an empty scene.

        Args:
            api: `client.scene` of one browser, or `server.scene` of all.
            content: what is shown.
            config: how much of it.
        """
        self._api, self._content, self._config = api, content, config
        self._models = {o.instance: o.obj_id for o in content.scene.objects}
        self._verdicts: dict[int, str] = {o.instance: o.verdict for o in content.scene.objects}
        self._look: Look = "appearance"
        self._roots: dict[int, viser.FrameHandle] = {}
        self._appearance: dict[int, viser.GlbHandle] = {}
        self._judged: dict[int, viser.MeshHandle] = {}
        self._ellipsoids: dict[int, viser.MeshHandle] = {}
        self._cameras: viser.FrameHandle | None = None
        self._frustums: dict[int, viser.CameraFrustumHandle] = {}
        self._grid: viser.GridHandle | None = None
        self._box: viser.LineSegmentsHandle | None = None
        self.cloud = CloudNodes(api, content.cloud, config)
        self.grasps = GraspNodes(api)
        """The measured points, and the grasps."""
        self._on_object: OnInstance = lambda _: None
        self._on_camera: OnInstance = lambda _: None
        # The pieces of the cloud come from a thread of their own while buttons are pressed.
        self._lock = threading.RLock()

    def build(self) -> None:
        """Send the scene with the coarse cloud; `cloud.refine` sends the rest."""
        with self._lock:
            self._api.set_up_direction(self._content.look.up)
            if self._content.scene.plane is not None:
                T_world_table = self._content.scene.plane.T_world_table
                self._grid = add_table(self._api, T_world_table, self._config)
            for placed in self._content.scene.objects:
                self._add_object(placed.instance, placed.T_world_obj)
            self.cloud.build()
            self._add_cameras()

    def clear(self) -> None:
        """Take everything away, and stop sending."""
        self.cloud.clear()
        with self._lock:
            self.grasps.clear()
            for handle in (*self._roots.values(), *self._ellipsoids.values(), self._cameras,
                           self._grid):  # fmt: skip
                if handle is not None:
                    handle.remove()
            for nodes in (self._roots, self._appearance, self._judged, self._ellipsoids,
                          self._frustums):  # fmt: skip
                nodes.clear()
            self._cameras = self._grid = self._box = None

    # --- objects ------------------------------------------------------------------------------

    def place(self, instance: int, T_world_obj: Array) -> None:
        """Move an object, with all that belongs to it but its grasps, to a pose (4, 4).

        Raises:
            InputError: there is no such object.
        """
        root = self._root(instance)
        root.wxyz, root.position = viser_wxyz_position(T_world_obj)

    def swap(self, instance: int, obj_id: int) -> None:
        """Show another model in an object's place.

        Raises:
            InputError: there is no such object or model.
        """
        self._root(instance)
        _ = self._content.meshes[obj_id]
        if self._models[instance] == obj_id:
            return
        with self._lock:
            self._models[instance] = obj_id
            for nodes in (self._appearance, self._judged):
                handle = nodes.pop(instance, None)
                if handle is not None:
                    handle.remove()
            self._show(instance)

    def color_verdict(self, instance: int, verdict: str) -> None:
        """Give an object the colour of a verdict.

        Raises:
            InputError: there is no such object or verdict.
        """
        self._root(instance)
        if verdict not in VERDICT_RGB:
            raise InputError(f"'{verdict}' is no verdict; there are {', '.join(VERDICT_RGB)}.")
        if self._verdicts[instance] != verdict:
            self._verdicts[instance] = verdict
            self._paint(instance)

    def show_objects(self, look: Look) -> None:
        """Show the objects as they look, in the colours of their verdicts, faded, or not at all.

        Raises:
            InputError: another look is asked for.
        """
        if look not in get_args(Look):
            listed = ", ".join(get_args(Look))
            raise InputError(f"objects cannot be shown as '{look}'; {listed} are accepted.")
        with self._lock:
            self._look = look
            for instance in self._roots:
                self._show(instance)

    def highlight(self, instance: int | None) -> None:
        """Draw a box about one object; None = about none.

        Raises:
            InputError: there is no such object.
        """
        with self._lock:
            if self._box is not None:
                self._box.remove()
                self._box = None
            if instance is None:
                return
            name = self._root(instance).name
            mesh = self._content.meshes[self._models[instance]]
            lines = box_edges(mesh.low, mesh.high)
            self._box = self._api.add_line_segments(
                f"{name}/box", lines, HIGHLIGHT_RGB, thickness=2.0, thickness_units="screen",
            )  # fmt: skip

    def ellipsoids(self, shapes: Mapping[int, Ellipsoid | None]) -> None:
        """Draw how sure the positions are, instead of what was drawn before.

        Args:
            shapes: instance -> ellipsoid in world; None = nothing is known of it.
        """
        with self._lock:
            for handle in self._ellipsoids.values():
                handle.remove()
            self._ellipsoids.clear()
            sphere = unit_sphere()
            for instance, shape in shapes.items():
                if shape is None:
                    continue
                wxyz, position = viser_wxyz_position(shape.T_world_ellipsoid)
                self._ellipsoids[instance] = self._api.add_mesh_simple(
                    f"/ellipsoids/{instance}",
                    (sphere.vertices * shape.radii_m).astype(np.float32),
                    sphere.faces.astype(np.uint32),
                    color=ELLIPSOID_RGB, opacity=0.45, cast_shadow=False, receive_shadow=False,
                    wxyz=wxyz, position=position,
                )  # fmt: skip

    def _root(self, instance: int) -> viser.FrameHandle:
        if instance not in self._roots:
            listed = ", ".join(map(str, sorted(self._roots))) or "none"
            raise InputError(f"instance {instance} is not in the scene; there are {listed}.")
        return self._roots[instance]

    def _add_object(self, instance: int, T_world_obj: Array) -> None:
        wxyz, position = viser_wxyz_position(T_world_obj)
        self._roots[instance] = self._api.add_frame(
            f"/objects/{instance}", show_axes=False, wxyz=wxyz, position=position
        )
        self._show(instance)

    def _show(self, instance: int) -> None:
        """Bring what is seen of an object in line with the look that is asked for."""
        if self._look == "appearance" and instance not in self._appearance:
            self._add_appearance(instance)
        plain = self._look in ("verdict", "faded")
        if plain and instance not in self._judged:
            self._add_judged(instance)
        self._paint(instance)
        if instance in self._appearance:
            self._appearance[instance].visible = self._look == "appearance"
        if instance in self._judged:
            self._judged[instance].visible = plain

    def _paint(self, instance: int) -> None:
        """Give an object's plain mesh the colour of its verdict, or fade it."""
        if instance in self._judged and self._look != "hidden":
            is_faded = self._look == "faded"
            color = FADED_RGB if is_faded else VERDICT_RGB[self._verdicts[instance]]
            handle = self._judged[instance]
            handle.color, handle.opacity = color, FADED if is_faded else None

    def _add_appearance(self, instance: int) -> None:
        mesh = self._content.meshes[self._models[instance]]
        handle = self._api.add_glb(
            f"/objects/{instance}/appearance", mesh.glb, cast_shadow=False, receive_shadow=False
        )
        handle.on_click(lambda _: self._on_object(instance))
        self._appearance[instance] = handle

    def _add_judged(self, instance: int) -> None:
        mesh = self._content.meshes[self._models[instance]]
        handle = self._api.add_mesh_simple(
            f"/objects/{instance}/verdict", mesh.vertices, mesh.faces,
            color=VERDICT_RGB[self._verdicts[instance]], flat_shading=True, side="double",
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        handle.on_click(lambda _: self._on_object(instance))
        self._judged[instance] = handle

    # --- cloud, cameras, table ----------------------------------------------------------------

    def show_cameras(self, visible: bool) -> None:
        """Show or hide the cameras."""
        if self._cameras is not None:
            self._cameras.visible = visible

    def clear_sight(self, eye: Array, look_at: Array) -> None:
        """Hide the frustums between an eye (3,) and what it looks at (3,), and show the others [m].

        A frustum in the way is one in the nearer `SIGHT_SHARE` of the line of sight or nearer, in a
        cone about it.
        """
        views = self._content.shown_views
        offset = np.array([v.T_world_cam for v in views]).reshape(-1, 4, 4)[:, :3, 3] - eye
        line = np.asarray(look_at) - eye
        length = float(np.linalg.norm(line))
        along = offset @ line / max(length, 1e-9)
        far = np.linalg.norm(offset, axis=1)
        in_cone = along > SIGHT_COS * far
        blocks = (in_cone & (far < SIGHT_SHARE * length)) | (far < 4 * self._config.frustum_m)
        with self._lock:
            for view, is_hidden in zip(views, blocks.tolist(), strict=True):
                handle = self._frustums.get(view.index)
                if handle is not None and handle.visible == is_hidden:
                    handle.visible = not is_hidden

    def show_table(self, visible: bool) -> None:
        """Show or hide the table."""
        if self._grid is not None:
            self._grid.visible = visible

    def _add_cameras(self) -> None:
        """Add a frustum with its photograph per shown view."""
        self._cameras = self._api.add_frame("/cameras", show_axes=False)
        for view in self._content.shown_views:
            name = f"/cameras/{view.index:06d}"
            handle = add_frustum(self._api, name, view, self._content, self._config)
            handle.on_click(lambda _, index=view.index: self._on_camera(index))
            self._frustums[view.index] = handle

    # --- grasps -------------------------------------------------------------------------------

    def draw_grasps(
        self, chosen: GraspFilter, Ts_world_obj: Mapping[int, Array] | None = None
    ) -> int:
        """Draw the grasps that pass a filter in place of those drawn before.

        Args:
            chosen: the filter.
            Ts_world_obj: instance -> pose (4, 4) where objects were moved; others stand as
                registered.

        Returns:
            how many are drawn: at most `SceneConfig.most_grasps` of those that pass.
        """
        poses = {o.instance: o.T_world_obj for o in self._content.scene.objects}
        found = chosen_grasps(self._content.grasp_sets, chosen, self._config.most_grasps)
        with self._lock:
            return self.grasps.draw(found, poses | dict(Ts_world_obj or {}))

    # --- clicks -------------------------------------------------------------------------------

    def on_object(self, callback: OnInstance) -> None:
        """Call back with the instance of an object that is clicked."""
        self._on_object = callback

    def on_camera(self, callback: OnInstance) -> None:
        """Call back with the number of the view whose frustum is clicked."""
        self._on_camera = callback


def light(api: viser.SceneApi, up: Array | tuple[float, float, float]) -> None:
    """Light a scene from an open sky; `up` (3,) is in world.

    Viser's own photograph of a sky and its maps of shadows cost a browser without a graphics card
    more than all that is drawn. The sky here has the mean light of that photograph.
    """
    api.configure_environment_map(None)
    api.configure_default_lights(cast_shadow=False)
    api.add_light_hemisphere("/sky", ground_color=GROUND_RGB, intensity=SKY, position=tuple(up))


def add_frustum(
    api: viser.SceneApi, name: str, view: View, content: SceneContent, config: SceneConfig
) -> viser.CameraFrustumHandle:
    """Add the camera of a view with its photograph, if it has one."""
    i, rgb = content.intrinsics, DAMAGED_RGB if view.index in content.damaged else FRUSTUM_RGB
    wxyz, position = viser_wxyz_position(np.asarray(view.T_world_cam))
    handle = api.add_camera_frustum(
        name, 2 * float(np.arctan2(i.height / 2, i.fy)), i.width / i.height,
        scale=config.frustum_m, thickness=FRUSTUM_LINE_M, color=rgb, format="jpeg",
        wxyz=wxyz, position=position, cast_shadow=False, receive_shadow=False,
    )  # fmt: skip
    jpeg = content.thumbnails.get(view.index)
    if jpeg is not None:
        # The JPEG itself: `image` would be encoded again for every browser.
        handle._image_data = jpeg  # pyright: ignore[reportPrivateUsage]
    return handle


def add_table(api: viser.SceneApi, T_world_table: Array, config: SceneConfig) -> viser.GridHandle:
    """Add the support plane as a grid of 5 cm, and 25 cm in bold."""
    wxyz, position = viser_wxyz_position(T_world_table)
    return api.add_grid(
        "/table", config.grid_m, config.grid_m, cell_size=0.05, section_size=0.25,
        cell_color=(205, 205, 205), section_color=(150, 150, 150),
        plane_color=(235, 235, 235), plane_opacity=0.35, wxyz=wxyz, position=position,
    )  # fmt: skip


def box_edges(low: Array, high: Array) -> Array32:
    """Return the edges (12, 2, 3) of a box that stands off these corners (3,) [m]."""
    low, high = low - BOX_MARGIN_M, high + BOX_MARGIN_M
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    edges = [(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1]
    return (low + corners[np.array(edges)] * (high - low)).astype(np.float32)
