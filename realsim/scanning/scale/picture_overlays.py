"""The scaled model on the session's photographs, and beside each what the depth says."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.arrays import Array, Array32, Image, evenly
from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.pages.plots import png
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.overlay import draw_outlines
from realsim.rendering.rays import PlacedMesh, RayScene, rotated
from realsim.scanning.scale.pictures import INK, MUTED, diverging_map, new_figure
from realsim.scanning.scale.result import ScaleFit, ViewAgreement
from realsim.scanning.shading import diverging

Window = tuple[slice, slice]
OUTLINE = (255, 196, 0)
"""Colour of the model's outline: none of an object's usual ones."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Photograph:
    """One view of the session as it was taken."""

    index: int
    """Number of the view."""
    rgb: Image
    """(H, W, 3)."""
    depth_m: Array32
    """(H, W) depth along z [m]; 0 = none."""
    T_world_cam: Array
    """(4, 4) camera in world [m]."""


VIEWS = 6
"""At most so many: the worst, and others spread over the session."""
MARGIN = 0.35
"""Surroundings shown on each side of the object [share of its size in the picture]."""
ASPECT = 4 / 3
"""Width / height of a picture."""
RANGE_MM = 5.0
"""The strongest colour of the depth residual [mm]: a scale off by 5 % moves the surface of a
10 cm object by that."""


def chosen_views(fit: ScaleFit) -> tuple[int, ...]:
    """Return the numbers of the views to look at: the worst two, the others spread evenly."""
    n = VIEWS
    if len(fit.views) <= n:
        return tuple(v.index for v in fit.views)
    worst = [v.index for v in worst_views(fit)[:2]]
    rest = [v.index for v in fit.views if v.index not in worst]
    return tuple(sorted([*worst, *evenly(rest, n - len(worst))]))


def worst_views(fit: ScaleFit) -> list[ViewAgreement]:
    """Return the views, worst first: those left out, then by how much of the depth agrees."""
    return sorted(fit.views, key=lambda v: (v.used, np.nan_to_num(v.agree, nan=-1.0)))


def overlays_png(
    mesh: Mesh, fit: ScaleFit, intrinsics: CameraIntrinsics, photographs: Sequence[Photograph]
) -> bytes:
    """Return photographs with the scaled model's outline, the depth residual beside each.

    Args:
        mesh: the mesh, in its own unit.
        fit: its fit.
        intrinsics: the raw camera.
        photographs: the views to draw.

    Raises:
        InputError: no photographs.
    """
    if not photographs:
        raise InputError("no photographs were given to draw the model on.")
    scaled = Mesh(vertices=fit.scale * mesh.vertices, faces=mesh.faces)
    scene = RayScene([PlacedMesh(0, scaled, fit.T_world_obj)])
    world = se3.transform(fit.T_world_obj, scaled.vertices)
    agreement = {v.index: v for v in fit.views}
    columns = 2 if len(photographs) > 1 else 1
    rows = -(-len(photographs) // columns)
    figure = new_figure(5.6 * columns, 0.9 + 2.35 * rows, fit)
    axes = np.atleast_2d(figure.subplots(rows, 2 * columns, squeeze=False))
    for ax in axes.ravel():
        ax.axis("off")
    for k, photo in enumerate(photographs):
        row, column = divmod(k, columns)
        left, right = axes[row, 2 * column : 2 * column + 2]
        picture, residual = _view_pair(scene, world, intrinsics, photo)
        left.imshow(picture, interpolation="antialiased")
        right.imshow(residual, interpolation="antialiased")
        title, color = _caption(photo.index, agreement.get(photo.index))
        left.set_title(title, fontsize=8, color=color, loc="left")
    _residual_bar(figure, axes, RANGE_MM)
    return png(figure)


def _caption(index: int, view: ViewAgreement | None) -> tuple[str, str]:
    """Return what stands above a pair of pictures, and its colour."""
    if view is None:
        return f"view {index}", MUTED
    text = f"view {index}: agree {view.agree:.2f}, IoU {view.iou:.2f}, RMS {view.rms_mm:.2f} mm"
    return (text, INK) if view.used else (f"{text} – LEFT OUT", "#c8553d")


def _residual_bar(figure: Any, axes: Any, limit: float) -> None:
    """Add the colour bar of the depth residual."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    mappable = ScalarMappable(Normalize(-limit, limit), diverging_map())
    bar = figure.colorbar(
        mappable, ax=axes, orientation="horizontal", shrink=0.5, aspect=45, extend="both", pad=0.02
    )
    bar.set_label(
        "model's depth − measured depth [mm]: blue where the real surface lies behind the model's, "
        "red in front; grey: not measured",
        fontsize=8,
    )
    bar.ax.tick_params(labelsize=8)


def _view_pair(
    scene: RayScene, world: Array, intrinsics: CameraIntrinsics, photo: Photograph
) -> tuple[Image, Image]:
    """Return the photograph with the outline, and the depth residual, around the object."""
    window = object_window(world, intrinsics, photo.T_world_cam)
    rgb = np.ascontiguousarray(photo.rgb[window])
    rendered = rendered_depth(scene, intrinsics, photo.T_world_cam, window)
    is_object = np.isfinite(rendered)
    ids = np.where(is_object, 0, -1).astype(np.int32)
    thickness = max(1, round(rgb.shape[1] / 220))
    picture = draw_outlines(rgb, ids, {0: OUTLINE}, thickness)
    measured = photo.depth_m[window].astype(np.float64)
    beyond = np.where(measured > 0, 1e3 * (rendered - measured), np.nan)
    grey = 0.45 * rgb.mean(-1, keepdims=True).repeat(3, -1) + 0.55 * 255
    residual = np.where(is_object[..., None], diverging(beyond, RANGE_MM), grey)
    return picture, np.clip(np.round(residual), 0, 255).astype(np.uint8)


def rendered_depth(
    scene: RayScene, intrinsics: CameraIntrinsics, T_world_cam: Array, window: Window
) -> Array:
    """Return the depth along z of the model in a window of the picture [m]; NaN = not there."""
    rays = rotated(camera.ray_table(intrinsics)[window], T_world_cam[:3, :3])
    shape = rays.shape[:2]
    flat = rays.reshape(-1, 3)
    known = np.isfinite(flat[:, 0])
    depth = np.full(len(flat), np.nan)
    t, _ = scene.first_hits(T_world_cam[:3, 3], flat[known])
    depth[known] = np.where(np.isfinite(t), t, np.nan)
    return depth.reshape(shape)


def object_window(world: Array, intrinsics: CameraIntrinsics, T_world_cam: Array) -> Window:
    """Return the part of the picture that shows points (N, 3) of world, with its surroundings.

    The whole picture where they are not in it.
    """
    uv = camera.project(intrinsics, se3.transform(se3.invert(T_world_cam), world))
    uv = uv[np.isfinite(uv).all(-1)]
    size = np.array([intrinsics.width, intrinsics.height], dtype=np.float64)
    whole = (slice(0, intrinsics.height), slice(0, intrinsics.width))
    if len(uv) == 0:
        return whole
    low, high = np.clip(uv.min(0), 0, size - 1), np.clip(uv.max(0), 0, size - 1)
    wide = (high - low) * (1 + 2 * MARGIN)
    if not np.all(wide > 2):
        return whole
    wide = np.array([max(wide[0], wide[1] * ASPECT), max(wide[1], wide[0] / ASPECT)])
    wide = np.minimum(wide, size)
    corner = np.clip((low + high) / 2 - wide / 2, 0, size - wide)
    x, y = np.floor(corner).astype(int)
    w, h = np.ceil(wide).astype(int)
    return slice(int(y), int(y + h)), slice(int(x), int(x + w))
