"""The review's scene in the browser: meshes, cloud, cameras, table and grasps as viser nodes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from realsim.geometry import mesh as mesh_tools
from realsim.interop import viser_wxyz_position
from realsim.records import GraspSet, Mesh, ObjectModel, ObjectPose, SupportPlane, View
from realsim.rendering.overlay import VERDICT_RGB
from realsim.review import content
from realsim.store import SessionStore

PLAIN_RGB = (176, 182, 190)
"""Colour of a mesh without colours of its own."""
FRUSTUM_RGB = (70, 96, 140)


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneConfig:
    """How much is shown; a browser without a graphics card should still turn the scene."""

    voxel_m: float = 0.002
    """Edge of the cloud's voxels [m]: the depth noise of the camera at 0.4 m."""
    most_points: int = 200_000
    """Points of the cloud; ten times more still load, but turn at 1 frame/s without a GPU."""
    most_fused_views: int = 24
    """Views fused into the cloud: more add noise, not surface."""
    most_cameras: int = 64
    """Cameras drawn, evenly spread over the session."""
    thumbnail_px: int = 160
    """Width of the photographs in the frustums [px]."""
    most_grasps: int = 100
    """Grasps drawn per object; the filters choose among all."""
    frustum_m: float = 0.025
    """Length of a camera's frustum [m]."""
    margin_m: float = 0.2
    """How far about the objects the cloud is shown [m]: enough to see what they stand on."""
    grid_m: float = 1.2
    """Edge of the table's grid [m]."""
    gripper: content.GripperDrawing = field(default_factory=content.GripperDrawing)
    """How a grasp is drawn."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GraspFilter:
    """Which grasps are drawn."""

    min_score: float = 0.0
    """Least score in [0, 1]."""
    reachable_only: bool = False
    """Only those the arm reaches without a collision."""
    instance: int | None = None
    """Only those of this object; None = of all."""
    show: bool = True
    """Whether any are drawn."""


class SceneNodes:
    """The nodes of one session in a viser server."""

    def __init__(self, server: viser.ViserServer, config: SceneConfig) -> None:
        """Start with an empty scene."""
        self._scene = server.scene
        self._config = config
        self._appearance: dict[int, Any] = {}
        self._judged: dict[int, viser.MeshHandle] = {}
        self._cameras: list[viser.CameraFrustumHandle] = []
        self._cloud: viser.PointCloudHandle | None = None
        self._grid: viser.GridHandle | None = None

    def add_objects(self, objects: Sequence[ObjectPose], models: Mapping[int, ObjectModel]) -> None:
        """Add every object twice: as it looks, and in the colour of its verdict."""
        for placed in objects:
            wxyz, position = viser_wxyz_position(placed.T_world_obj)
            mesh = models[placed.obj_id].mesh
            pose: dict[str, Any] = {"wxyz": wxyz, "position": position, "cast_shadow": False}
            self._appearance[placed.instance] = self._scene.add_mesh_trimesh(
                f"/objects/{placed.instance}/appearance", _colored_trimesh(mesh), **pose
            )
            self._judged[placed.instance] = self._scene.add_mesh_simple(
                f"/objects/{placed.instance}/verdict",
                mesh.vertices.astype(np.float32),
                mesh.faces.astype(np.uint32),
                color=VERDICT_RGB[placed.verdict],
                flat_shading=True,
                side="double",
                **pose,
            )

    def show_objects(self, visible: bool, by_verdict: bool) -> None:
        """Show the objects as they look, or in the colours of their verdicts, or not at all."""
        for handle in self._appearance.values():
            handle.visible = visible and not by_verdict
        for handle in self._judged.values():
            handle.visible = visible and by_verdict

    def color_object(self, instance: int, verdict: str) -> None:
        """Give an object the colour of its verdict."""
        self._judged[instance].color = VERDICT_RGB[verdict]

    def add_cloud(self, points: NDArray[np.float32], colors: NDArray[np.uint8]) -> None:
        """Add the fused depth; in float32, because viser's float16 has steps of 1 mm at 1 m."""
        self._cloud = self._scene.add_point_cloud(
            "/cloud",
            points,
            colors,
            point_size=0.8 * self._config.voxel_m,
            point_shape="circle",
            precision="float32",
        )

    def show_cloud(self, visible: bool) -> None:
        """Show or hide the cloud."""
        if self._cloud is not None:
            self._cloud.visible = visible

    def add_cameras(self, store: SessionStore, views: Sequence[View]) -> None:
        """Add a frustum with its photograph per view; a click moves the browser's camera there."""
        i = store.session.intrinsics
        fov = 2 * float(np.arctan2(i.height / 2, i.fy))
        for view in views:
            assert view.T_world_cam is not None
            wxyz, position = viser_wxyz_position(view.T_world_cam)
            handle = self._scene.add_camera_frustum(
                f"/cameras/{view.index:06d}",
                fov,
                i.width / i.height,
                scale=self._config.frustum_m,
                thickness=0.001,
                color=FRUSTUM_RGB,
                image=content.thumbnail(store.rgb(view.index), self._config.thumbnail_px),
                format="jpeg",
                jpeg_quality=70,
                wxyz=wxyz,
                position=position,
                cast_shadow=False,
            )
            handle.on_click(_go_to(view))
            self._cameras.append(handle)

    def show_cameras(self, visible: bool) -> None:
        """Show or hide the cameras."""
        for handle in self._cameras:
            handle.visible = visible

    def add_table(self, plane: SupportPlane) -> None:
        """Add the support plane as a grid of 5 cm, and 25 cm in bold."""
        wxyz, position = viser_wxyz_position(plane.T_world_table)
        self._grid = self._scene.add_grid(
            "/table",
            self._config.grid_m,
            self._config.grid_m,
            cell_size=0.05,
            section_size=0.25,
            cell_color=(205, 205, 205),
            section_color=(150, 150, 150),
            plane_color=(235, 235, 235),
            plane_opacity=0.35,
            wxyz=wxyz,
            position=position,
        )

    def show_table(self, visible: bool) -> None:
        """Show or hide the table."""
        if self._grid is not None:
            self._grid.visible = visible

    def draw_grasps(
        self, objects: Sequence[ObjectPose], sets: Sequence[GraspSet], chosen: GraspFilter
    ) -> int:
        """Draw the grasps that pass the filter in place of those drawn before; return how many."""
        poses = {o.instance: o.T_world_obj for o in objects}
        drawn = 0
        for grasps in sets:
            name = f"/grasps/{grasps.instance}"
            kept = content.chosen_grasps(
                grasps, chosen.min_score, chosen.reachable_only, self._config.most_grasps
            )
            other = chosen.instance is not None and chosen.instance != grasps.instance
            if not chosen.show or other or len(kept) == 0:
                self._scene.remove_by_name(name)
                continue
            Ts = poses[grasps.instance] @ grasps.Ts_obj_grasp[kept]
            lines = content.gripper_segments(Ts, grasps.widths_m[kept], self._config.gripper)
            colors = content.linear_rgb(content.score_rgb(grasps.scores[kept]))
            per_end = np.broadcast_to(colors[:, None, None], lines.shape).reshape(-1, 2, 3)
            self._scene.add_line_segments(
                name, lines.reshape(-1, 2, 3).astype(np.float32), per_end, thickness=0.0012
            )
            drawn += len(kept)
        return drawn


def _colored_trimesh(mesh: Mesh) -> Any:
    """Return the mesh with its texture, its vertex colours, or plain grey."""
    from trimesh.visual import ColorVisuals, TextureVisuals
    from trimesh.visual.material import PBRMaterial

    shape = mesh_tools.to_trimesh(mesh)
    if mesh.texture is not None and mesh.uv is not None:
        from PIL import Image

        # A rough, non-metallic material: the default one of glTF is a mirror in viser's light.
        material = PBRMaterial(
            baseColorTexture=Image.fromarray(mesh.texture), metallicFactor=0.0, roughnessFactor=0.9
        )
        shape.visual = TextureVisuals(uv=mesh.uv, material=material)
        return shape
    colors = mesh_tools.vertex_colors(mesh)
    if colors is None:
        colors = np.tile(np.array(PLAIN_RGB, dtype=np.uint8), (len(mesh.vertices), 1))
    shape.visual = ColorVisuals(shape, vertex_colors=colors)
    return shape


def _go_to(view: View) -> Any:
    """Return the callback that moves the camera of the clicking browser to a view."""
    wxyz, position = viser_wxyz_position(np.asarray(view.T_world_cam))

    def go(event: Any) -> None:
        with event.client.atomic():
            event.client.camera.wxyz = wxyz
            event.client.camera.position = position

    return go
