"""The static page's scene in viser's own format.

A server of viser is started for a moment on the loopback interface, because only a running one
takes nodes; nobody is told its port, and it is stopped before the page is written.
"""

import contextlib
import io
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim import local_pages
from realsim.arrays import Array, Int64
from realsim.interop import viser_wxyz_position
from realsim.records import GraspSet, Scene
from realsim.rendering.overlay import VERDICT_RGB, evenly_ranked, grasp_rgb
from realsim.review.content.config import SceneConfig
from realsim.review.content.content import SceneContent
from realsim.review.content.meshes import glb_of, within_budget
from realsim.review.content.views import spread
from realsim.review.drawing.grasp_drawing import gripper_mesh, gripper_scales, linear_rgb

LABEL_EDGES = (0.0, 0.25, 0.5, 0.75)
"""Lower ends of the classes of p_hold or score that the page can show or hide."""
BOX_LINE_M = 0.0015
"""Thickness of the box about the chosen object [m]."""
BOX_GROWN = 0.05
"""By which share of its size the box stands off the object."""
POINT_SHARE = 0.5
"""Size of a drawn point over the voxels: gaps let the models be seen behind their points."""
FRUSTUM_RGB = (70, 96, 140)
FRUSTUM_LINE_M = 0.0008


@dataclass(frozen=True, kw_only=True, slots=True)
class StaticSize:
    """How much of a scene goes into the file."""

    points: int = 300_000
    """Points of the cloud: 15 B each, compressed and as text 14."""
    grasps: int = 40
    """Grasps of an object: more hide each other."""
    cameras: int = 128
    """Cameras with their photographs: 4 kB each."""
    texels: int = 1024
    """Longest side of a texture [px]; as JPEG 150 to 300 kB."""
    triangles: int = 20_000
    """Triangles of an object without a texture; with one, five times as many."""

    def smaller(self) -> "StaticSize":
        """Return a size of about half the bytes."""
        return StaticSize(
            points=max(self.points // 2, 1),
            grasps=max(self.grasps // 2, 10),
            cameras=max(self.cameras // 2, 8),
            texels=max(int(self.texels / np.sqrt(2.0)), 64),
            triangles=max(self.triangles // 2, 500),
        )


def viewer_html(content: SceneContent, scene: Scene, size: StaticSize) -> str:
    """Return viser's page with the scene in it; it needs no server.

    Args:
        content: what is drawn.
        scene: the objects as the reviewers left them.
        size: how much of it.
    """
    import viser

    # Viser prints a banner with an address that nobody is to open.
    with local_pages.guarded(local_pages.Door()), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            look = content.look
            _build(server.scene, content, scene, size)
            server.scene.set_up_direction(look.up)
            server.initial_camera.up = tuple(look.up)
            server.initial_camera.position = tuple(look.position)
            server.initial_camera.look_at = tuple(look.look_at)
            return server.get_scene_serializer().as_html()
        finally:
            server.stop()


def _build(api: Any, content: SceneContent, scene: Scene, size: StaticSize) -> None:
    config = SceneConfig()
    kept = min(size.points, len(content.cloud))
    if kept:
        # Fewer points of the same scene are drawn larger.
        coarser = float(np.sqrt(len(content.cloud) / kept))
        api.add_point_cloud(
            "/cloud",
            content.cloud.points[:kept],
            content.cloud.colors[:kept],
            point_size=POINT_SHARE * content.cloud.voxel_m * min(coarser, 2.0),
            point_shape="circle",
            precision="float32",
        )
    if scene.plane is not None:
        _add_table(api, scene.plane.T_world_table, config.grid_m)
    _add_cameras(api, content, size, config)
    _add_objects(api, content, scene, size)
    _add_grasps(api, content, scene, size, config)


def _add_table(api: Any, T_world_table: Array, grid_m: float) -> None:
    wxyz, position = viser_wxyz_position(T_world_table)
    api.add_grid(
        "/table",
        grid_m,
        grid_m,
        cell_size=0.05,
        section_size=0.25,
        cell_color=(205, 205, 205),
        section_color=(150, 150, 150),
        plane_color=(235, 235, 235),
        plane_opacity=0.35,
        wxyz=wxyz,
        position=position,
    )


def _add_cameras(api: Any, content: SceneContent, size: StaticSize, config: SceneConfig) -> None:
    import cv2

    k = content.intrinsics
    fov = 2.0 * float(np.arctan2(k.height / 2.0, k.fy))
    for view in spread(content.shown_views, size.cameras):
        assert view.T_world_cam is not None, "only views with a pose are shown"
        wxyz, position = viser_wxyz_position(view.T_world_cam)
        jpeg = np.frombuffer(content.thumbnails[view.index], dtype=np.uint8)
        api.add_camera_frustum(
            f"/cameras/{view.index}",
            fov,
            k.width / k.height,
            scale=config.frustum_m,
            thickness=FRUSTUM_LINE_M,
            color=FRUSTUM_RGB,
            image=np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR_RGB), dtype=np.uint8),
            format="jpeg",
            jpeg_quality=80,
            wxyz=wxyz,
            position=position,
            cast_shadow=False,
        )


def _add_objects(api: Any, content: SceneContent, scene: Scene, size: StaticSize) -> None:
    """Add every object, and a box in the colour of its verdict that shows which is chosen."""
    config = SceneConfig(
        most_triangles=size.triangles,
        most_textured_triangles=5 * size.triangles,
        most_texels=size.texels,
    )
    meshes = {i: content.models[i].mesh for i in {o.obj_id for o in scene.objects}}
    glbs = {i: glb_of(within_budget(m, config), size.texels) for i, m in meshes.items()}
    for placed in scene.objects:
        wxyz, position = viser_wxyz_position(placed.T_world_obj)
        api.add_glb(
            f"/objects/{placed.instance}",
            glbs[placed.obj_id],
            wxyz=wxyz,
            position=position,
            cast_shadow=False,
        )
        api.add_line_segments(
            f"/boxes/{placed.instance}",
            box_edges(*meshes[placed.obj_id].bounds).astype(np.float32),
            VERDICT_RGB[placed.verdict],
            thickness=BOX_LINE_M,
            wxyz=wxyz,
            position=position,
            visible=False,
        )


def box_edges(low: Array, high: Array) -> Array:
    """Return the edges (12, 2, 3) of a box that stands off these corners (3,) and (3,) [m]."""
    pad = BOX_GROWN * float(np.linalg.norm(high - low)) / 2.0
    axes = np.stack([low - pad, high + pad], axis=1)
    corners = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    pairs = [(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit]
    return corners[np.array(pairs)]


def _add_grasps(
    api: Any, content: SceneContent, scene: Scene, size: StaticSize, config: SceneConfig
) -> None:
    """Add the grasps in one node per object and class of the label."""
    vertices, faces = gripper_mesh(config.gripper)
    for grasps in content.grasp_sets:
        T_world_obj = scene.object(grasps.instance).T_world_obj
        rows = drawn_grasps(grasps, size.grasps)
        classes = label_class(grasps.labels)[rows]
        for k in sorted(set(classes.tolist())):
            some = rows[classes == k]
            wxyzs, positions = viser_wxyz_position(T_world_obj @ grasps.Ts_obj_grasp[some])
            api.add_batched_meshes_simple(
                f"/grasps/{grasps.instance}/{k}",
                vertices,
                faces,
                batched_wxyzs=wxyzs.astype(np.float32),
                batched_positions=positions.astype(np.float32),
                batched_scales=gripper_scales(grasps.widths_m[some]),
                batched_colors=linear_rgb(grasp_rgb(grasps, some)),
                flat_shading=True,
                side="double",
                lod="off",
                cast_shadow=False,
            )


def drawn_grasps(grasps: GraspSet, most: int) -> Int64:
    """Return the rows that are drawn: all, or evenly spread over the ranking by label."""
    return np.sort(evenly_ranked(grasps, most))


def label_class(labels: Array) -> Int64:
    """Return the class (N,) of labels (N,): number in LABEL_EDGES; -1 = not known."""
    found = np.searchsorted(LABEL_EDGES, np.nan_to_num(labels, nan=-1.0), side="right") - 1
    return np.where(np.isnan(labels), -1, np.maximum(found, 0)).astype(np.int64)
