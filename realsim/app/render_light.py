"""Light and table as the photographs show them: exposure and colour, matched by their means.

The scene is rendered small at a few real cameras under a soft neutral sky; the light is scaled per
colour until the mean of the objects' pixels is that of the photographs, the table's colour until
the mean of the table's pixels is. It is no inverse rendering: where lamps hang is not asked.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics, View
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.labels import LabelRenderer, Labels
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.review.content import spread, strided
from realsim.store import SessionStore
from realsim_sim_bridge.synthetic.scene import SyntheticScene

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rgb = NDArray[np.uint8]
VIEWS = 3
"""Real views that are looked at, spread over the session."""
SMALL_PX = 320
"""About so wide they are looked at: the mean of 50,000 pixels is as good as of a million."""
ROUNDS = 3
"""Renderings until the means agree: bounces and saturation make it not quite linear."""
SATURATED = 250
"""8-bit values from which a pixel says nothing of its light."""
LEAST_PIXELS = 50
"""Fewer object pixels than this say nothing."""
NEAR_TABLE_M = 0.05
"""Table pixels are taken up to this far around the objects [m]: further out the table may end."""
BASE_COLOR = (0.01, 0.95)
"""Least and greatest reflectance of a table: velvet and chalk."""
LEVEL = 1e-3
"""Sine of the tilt up to which a world stands upright."""
SKY_ROWS = 64
"""Rows of the neutral panorama."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ObservedLook:
    """What the photographs said."""

    environment: Environment
    table: Material | None
    """None = the scene has no table."""
    has_colors: bool
    """Whether the models have colours, so that the hue of the light could be matched."""
    object_error: float
    """Greatest difference left between the means of the objects' pixels, of white = 1 linear."""
    table_error: float
    """The same of the table's pixels; NaN = no table."""


def neutral_environment() -> Environment:
    """Return a soft grey room: bright above, darker below, one broad lamp at an angle."""
    elevation = np.pi / 2 - np.pi * (np.arange(SKY_ROWS) + 0.5) / SKY_ROWS
    up = np.sin(elevation)
    value = np.where(up > 0, 0.45 + 0.35 * up, 0.45 + 0.25 * up)
    panorama = np.broadcast_to(value[:, None, None], (SKY_ROWS, 2 * SKY_ROWS, 3))
    return Environment(
        panorama=panorama.astype(np.float32), sun=(0.5, 0.5, 0.5), sun_radius_deg=4.0,
        name="neutral room",
    )  # fmt: skip


def upright(environment: Environment, up: Array) -> Environment:
    """Return the surroundings turned so that their up, +z, is a direction (3,) of the world.

    A world that a data set's first camera spans has its z along that camera's view.
    """
    import cv2

    axis = np.cross([0.0, 0.0, 1.0], up)
    sine, cosine = float(np.linalg.norm(axis)), float(up[2])
    if sine < LEVEL and cosine > 0:
        return environment
    axis = axis / sine if sine > LEVEL else np.array([1.0, 0.0, 0.0])
    R = se3.exp_so3(np.arctan2(sine, cosine) * axis)  # world <- surroundings
    rows = environment.panorama.shape[0]
    polar = np.pi * (np.arange(rows) + 0.5) / rows
    around = np.pi * (np.arange(2 * rows) + 0.5) / rows
    level = np.sin(polar)[:, None]
    height = np.broadcast_to(np.cos(polar)[:, None], (rows, 2 * rows))
    d = np.stack([level * np.cos(around), level * np.sin(around), height], -1) @ R
    row = rows / np.pi * np.arccos(np.clip(d[..., 2], -1, 1)) - 0.5
    column = rows / np.pi * (np.arctan2(d[..., 1], d[..., 0]) % (2 * np.pi)) - 0.5
    # One column of the other side on each border: the panorama closes on itself.
    closed = np.concatenate(
        [environment.panorama[:, -1:], environment.panorama, environment.panorama[:, :1]], 1
    )
    panorama = cv2.remap(
        closed, (column + 1).astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    x, y, z = (float(v) for v in R @ np.array(environment.sun_direction))
    return replace(environment, panorama=np.asarray(panorama, np.float32), sun_direction=(x, y, z))


def matched_look(
    store: SessionStore, synthetic: SyntheticScene, *, keeps_table: bool, keeps_hue: bool
) -> ObservedLook | None:
    """Return light and table that make a scene as bright and as coloured as its photographs.

    Args:
        store: the session with the photographs.
        synthetic: the scene, under a first light and with a first table.
        keeps_table: whether the table's material was chosen and stays.
        keeps_hue: whether the light was chosen: only its exposure is matched.

    Returns:
        None where no photograph shows enough of the objects.
    """
    known = [v for v in store.session.views if v.T_world_cam is not None]
    # The objects are seen best where the camera is near them; any spread will do for a mean.
    views = spread(known, VIEWS)
    stride = max(1, round(store.session.intrinsics.width / SMALL_PX))
    camera = strided(store.session.intrinsics, stride)
    renderer = LabelRenderer(synthetic.placed())
    regions = [_regions(synthetic, renderer.render(camera, _pose(v)), camera, v) for v in views]
    photographs = [store.rgb(v.index)[::stride, ::stride] for v in views]
    shown = {o.obj_id for o in synthetic.shown}
    has_colors = all(
        synthetic.models[i].mesh.colors is not None or synthetic.models[i].mesh.texture is not None
        for i in shown
    )
    environment = synthetic.environment
    table = synthetic.surroundings[0].material if synthetic.surroundings else None
    error = table_error = float("nan")
    for round_ in range(ROUNDS + 1):
        pictures = _rendered(synthetic, environment, table, camera, views)
        means = _means(photographs, pictures, [r[0] for r in regions])
        if means is None:
            return None
        light = means[0] / np.maximum(means[1], 1e-4)
        if keeps_hue or not has_colors:
            light = np.full(3, means[0].mean() / max(float(means[1].mean()), 1e-4))
        error = float(np.abs(means[0] - means[1]).max())
        paint = _means(photographs, pictures, [r[1] for r in regions])
        if paint is not None:
            table_error = float(np.abs(paint[0] - paint[1]).max())
        if round_ == ROUNDS:
            break
        environment = _scaled(environment, light)
        if table is not None and paint is not None and not keeps_table:
            gain = paint[0] / np.maximum(paint[1], 1e-4) / light
            base = np.clip(np.array(table.base_color) * gain, *BASE_COLOR)
            table = replace(table, base_color=(float(base[0]), float(base[1]), float(base[2])))
    return ObservedLook(
        environment=environment, table=table, has_colors=has_colors, object_error=error,
        table_error=table_error,
    )  # fmt: skip


def _pose(view: View) -> Array:
    """Return the camera pose (4, 4) of a view that has one."""
    return np.asarray(view.T_world_cam)


def _regions(
    synthetic: SyntheticScene, labels: Labels, camera: CameraIntrinsics, view: View
) -> tuple[Mask, Mask]:
    """Return where (H, W) the objects are seen, without their rims, and the table near them."""
    import cv2

    objects = np.asarray(cv2.erode((labels.ids >= 0).astype(np.uint8), np.ones((3, 3), np.uint8)))
    table = (labels.ids < 0) & (labels.depth_m > 0)
    plane = synthetic.scene.plane
    if plane is None:
        return objects > 0, np.zeros_like(table)
    points = ray_table(camera) * labels.depth_m[..., None]
    T_table_cam = se3.invert(plane.T_world_table) @ _pose(view)
    on_table = points @ T_table_cam[:2, :3].T + T_table_cam[:2, 3]
    corners = np.concatenate(
        [
            se3.transform(
                se3.invert(plane.T_world_table) @ o.T_world_obj,
                synthetic.models[o.obj_id].mesh.vertices,
            )[:, :2]
            for o in synthetic.shown
        ]
    )
    low, high = corners.min(0) - NEAR_TABLE_M, corners.max(0) + NEAR_TABLE_M
    near = np.all((on_table > low) & (on_table < high), axis=-1)
    apart = cv2.dilate((labels.ids >= 0).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
    return objects > 0, table & near & np.asarray(apart)


def _rendered(
    synthetic: SyntheticScene,
    environment: Environment,
    table: Material | None,
    camera: CameraIntrinsics,
    views: list[View],
) -> list[Rgb]:
    """Return small noiseless pictures of the views."""
    from realsim.rendering.photo import PhotoRenderer

    placed = [
        PlacedMesh(p.instance, p.mesh, p.T_world_obj, table) if p.instance == BACKGROUND else p
        for p in synthetic.placed()
    ]
    renderer = PhotoRenderer(placed, environment=environment)
    return [renderer.render(camera, _pose(v)).rgb for v in views]


def _means(
    photographs: list[Rgb], pictures: list[Rgb], regions: list[Mask]
) -> tuple[Array, Array] | None:
    """Return the mean linear colours (3,) of photographs and pictures over regions of them."""
    real = np.concatenate([p[r] for p, r in zip(photographs, regions, strict=True)])
    made = np.concatenate([p[r] for p, r in zip(pictures, regions, strict=True)])
    fine = (real.max(-1) < SATURATED) & (made.max(-1) < SATURATED) if len(real) else []
    if int(np.count_nonzero(fine)) < LEAST_PIXELS:
        # All saturated: the values still say in which direction to go.
        if len(real) < LEAST_PIXELS:
            return None
        fine = np.ones(len(real), np.bool_)
    return linear_of(real[fine]).mean(0), linear_of(made[fine]).mean(0)


def linear_of(rgb: Rgb) -> Array:
    """Return the linear light of 8-bit sRGB values (IEC 61966-2-1)."""
    v = np.asarray(rgb, np.float64) / 255.0
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def _scaled(environment: Environment, gain: Array) -> Environment:
    """Return the light with each colour scaled."""
    r, g, b = (float(x) for x in np.array(environment.sun) * gain)
    panorama = environment.panorama * gain.astype(np.float32)
    return replace(environment, panorama=panorama, sun=(r, g, b))
