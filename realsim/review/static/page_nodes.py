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
from realsim.arrays import Array, Int64, evenly
from realsim.interop import viser_wxyz_position
from realsim.records import GraspSet, Scene
from realsim.rendering.overlay import VERDICT_RGB, evenly_ranked, grasp_rgb
from realsim.review.content.config import SceneConfig
from realsim.review.content.content import SceneContent
from realsim.review.content.meshes import glb_of, within_budget
from realsim.review.drawing.grasp_drawing import gripper_mesh, gripper_scales, linear_rgb
from realsim.review.drawing.scene_nodes import add_frustum, add_table, box_edges, light

LABEL_EDGES = (0.0, 0.25, 0.5, 0.75)
"""Lower ends of the classes of p_hold or score that the page can show or hide."""
BOX_LINE_M = 0.0015
"""Thickness of the box about the chosen object [m]."""
POINT_SHARE = 0.5
"""Size of a drawn point over the voxels: gaps let the models be seen behind their points."""


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
            light(server.scene, look.up)
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
        size_m = POINT_SHARE * content.cloud.voxel_m * min(coarser, 2.0)
        api.add_point_cloud(
            "/cloud", content.cloud.points[:kept], content.cloud.colors[:kept],
            point_size=size_m, point_shape="circle", precision="float32",
        )  # fmt: skip
    if scene.plane is not None:
        add_table(api, scene.plane.T_world_table, config)
    for view in evenly(content.shown_views, size.cameras):
        add_frustum(api, f"/cameras/{view.index}", view, content, config)
    _add_objects(api, content, scene, size)
    _add_grasps(api, content, scene, size)


def _add_objects(api: Any, content: SceneContent, scene: Scene, size: StaticSize) -> None:
    """Add every object, and a box in the colour of its verdict that shows which is chosen."""
    config = SceneConfig(
        most_triangles=size.triangles, most_textured_triangles=5 * size.triangles,
        most_texels=size.texels,
    )  # fmt: skip
    meshes = {i: content.models[i].mesh for i in {o.obj_id for o in scene.objects}}
    glbs = {i: glb_of(within_budget(m, config), size.texels) for i, m in meshes.items()}
    for placed in scene.objects:
        wxyz, position = viser_wxyz_position(placed.T_world_obj)
        stands: Any = {"wxyz": wxyz, "position": position}
        name, edges = f"/objects/{placed.instance}", box_edges(*meshes[placed.obj_id].bounds)
        api.add_glb(name, glbs[placed.obj_id], cast_shadow=False, **stands)
        api.add_line_segments(
            f"/boxes/{placed.instance}", edges, VERDICT_RGB[placed.verdict],
            thickness=BOX_LINE_M, visible=False, **stands,
        )  # fmt: skip


def _add_grasps(api: Any, content: SceneContent, scene: Scene, size: StaticSize) -> None:
    """Add the grasps in one node per object and class of the label."""
    vertices, faces = gripper_mesh()
    for grasps in content.grasp_sets:
        T_world_obj = scene.object(grasps.instance).T_world_obj
        rows = drawn_grasps(grasps, size.grasps)
        classes = label_class(grasps.labels)[rows]
        for k in sorted(set(classes.tolist())):
            some = rows[classes == k]
            wxyzs, positions = viser_wxyz_position(T_world_obj @ grasps.Ts_obj_grasp[some])
            api.add_batched_meshes_simple(
                f"/grasps/{grasps.instance}/{k}", vertices, faces,
                batched_wxyzs=wxyzs.astype(np.float32),
                batched_positions=positions.astype(np.float32),
                batched_scales=gripper_scales(grasps.widths_m[some]),
                batched_colors=linear_rgb(grasp_rgb(grasps, some)),
                flat_shading=True, side="double", lod="off", cast_shadow=False,
            )  # fmt: skip


def drawn_grasps(grasps: GraspSet, most: int) -> Int64:
    """Return the rows that are drawn: all, or evenly spread over the ranking by label."""
    return np.sort(evenly_ranked(grasps, most))


def label_class(labels: Array) -> Int64:
    """Return the class (N,) of labels (N,): number in LABEL_EDGES; -1 = not known."""
    found = np.searchsorted(LABEL_EDGES, np.nan_to_num(labels, nan=-1.0), side="right") - 1
    return np.where(np.isnan(labels), -1, np.maximum(found, 0)).astype(np.int64)
