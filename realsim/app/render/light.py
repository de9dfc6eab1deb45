"""Light and table as the photographs show them: exposure and colour, matched by their means.

The scene is rendered small at a few real cameras under a soft neutral sky; the light is scaled per
colour until the mean of the objects' pixels is that of the photographs, the table's colour until
the mean of the table's pixels is, and so is the paint of each object whose model has no colours. It
is no inverse rendering: where lamps hang is not asked.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from realsim.app.render.compare import label_ids
from realsim.arrays import Array, Int32, Mask, Rgb, evenly
from realsim.geometry import se3
from realsim.geometry.camera import ray_table
from realsim.geometry.colors import light_of_bytes
from realsim.records import CameraIntrinsics
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.labels import LabelRenderer, Labels
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.review.content.views import strided
from realsim.store import SessionStore
from realsim_sim_bridge.synthetic.scene import SyntheticScene

VIEWS = 3
"""Real views that are looked at, spread over the session."""
SMALL_PX = 320
"""About so wide they are looked at: the mean of 50,000 pixels is as good as of a million."""
ROUNDS = 3
"""Renderings until the means agree: bounces and saturation make it not quite linear."""
SATURATED = 250
"""8-bit values from which a pixel says nothing of its light."""
LEAST_PIXELS = 50
"""Fewer pixels than this say nothing of the light."""
LEAST_PAINTED = 6
"""Fewer pixels than this say nothing of an object's paint."""
NEAR_TABLE_M = 0.05
"""Table pixels are taken up to this far around the objects [m]: further out the table may end."""
BASE_COLOR = (0.01, 0.95)
"""Least and greatest reflectance of a table: velvet and chalk."""
MOST_HUE = 1.5
"""A channel of the light is at most so many times its mean, or under it: cameras balance white,
and a red object says next to nothing of the light's blue."""
PAINT = (0.35, 0.35, 0.35)
"""First reflectance of objects without colours; where none has any, their mean stays near it."""
PAINT_RANGE = (0.01, 0.9)
"""Least and greatest reflectance of a paint."""
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
    """Whether some model has colours, so that the hue of the light could be matched."""
    object_error: float
    """Greatest difference left between the means of the objects' pixels, of white = 1 linear."""
    table_error: float
    """The same of the table's pixels; NaN = no table."""
    paints: Mapping[int, Material]
    """Instance without colours of its own -> the colour that the photographs show."""


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
    """Return light, table and paints that make a scene as bright and coloured as its photographs.

    Objects that have colours tell the light; those that have none are painted in the mean colour
    that they show. Where none has colours the light is grey, and mean paint as well.

    Args:
        store: the session with the photographs.
        synthetic: the scene, under a first light and with a first table.
        keeps_table: whether the table's material was chosen and stays.
        keeps_hue: whether the light was chosen: only its exposure is matched.

    Returns:
        None where no photograph shows enough of the objects.
    """
    known = list(store.session.Ts_world_cam.items())
    if not known:
        return None
    # The objects are seen best where the camera is near them; any spread will do for a mean.
    views = dict(evenly(known, VIEWS))
    stride = max(1, round(store.session.intrinsics.width / SMALL_PX))
    camera = strided(store.session.intrinsics, stride)
    renderer = LabelRenderer(synthetic.placed())
    regions = [
        _regions(synthetic, renderer.render(camera, T), camera, T, _annotated(store, k, stride))
        for k, T in views.items()
    ]
    photographs = [store.rgb(k)[::stride, ::stride] for k in views]
    paints = {i: Material(base_color=PAINT, name="as photographed") for i in _colorless(synthetic)}
    colored = {o.instance for o in synthetic.shown} - set(paints)
    telling = [_seen(r, colored) for r in regions]
    if sum(int(np.count_nonzero(t)) for t in telling) < LEAST_PIXELS:
        telling, colored = [_seen(r, {*colored, *paints}) for r in regions], set[int]()
    environment, gain = synthetic.environment, np.ones(3)
    table = synthetic.surroundings[0].material if synthetic.surroundings else None
    error = table_error = float("nan")
    for round_ in range(ROUNDS + 1):
        look = replace(synthetic, environment=environment, materials=paints)
        pictures = _rendered(look, table, camera, views.values())
        means = _means(photographs, pictures, telling)
        if means is None:
            return None
        light = means[0] / np.maximum(means[1], 1e-4)
        if keeps_hue or not colored:
            light = np.full(3, means[0].mean() / max(float(means[1].mean()), 1e-4))
        error = float(np.abs(means[0] - means[1]).max())
        on_table = _means(photographs, pictures, [r.table for r in regions])
        if on_table is not None:
            table_error = float(np.abs(on_table[0] - on_table[1]).max())
        if round_ == ROUNDS:
            break
        before, gain = gain, _plausible(gain * light)
        light = gain / before
        environment = _scaled(synthetic.environment, gain)
        if table is not None and on_table is not None and not keeps_table:
            table = _repainted(table, on_table, light, BASE_COLOR)
        for instance, paint in paints.items():
            of_it = _means(
                photographs, pictures, [_seen(r, {instance}) for r in regions], LEAST_PAINTED
            )
            if of_it is not None:
                paints[instance] = _repainted(paint, of_it, light, PAINT_RANGE)
    return ObservedLook(
        environment=environment, table=table, has_colors=bool(colored), object_error=error,
        table_error=table_error, paints=paints,
    )  # fmt: skip


def _plausible(gain: Array) -> Array:
    """Return the light's gain (3,) with its hue kept to that of lamps before a balanced camera."""
    mean = float(gain.mean())
    return mean * np.clip(gain / mean, 1 / MOST_HUE, MOST_HUE)


def _colorless(synthetic: SyntheticScene) -> list[int]:
    """Return the instances whose model has neither colours nor a texture, nor a material."""
    return [
        o.instance
        for o in synthetic.shown
        if synthetic.models[o.obj_id].mesh.colors is None
        and synthetic.models[o.obj_id].mesh.texture is None
        and o.instance not in synthetic.materials
    ]


def _repainted(
    material: Material, means: tuple[Array, Array], light: Array, limits: tuple[float, float]
) -> Material:
    """Return a material whose pixels have the photographs' mean once the light is scaled."""
    gain = means[0] / np.maximum(means[1], 1e-4) / light
    r, g, b = (float(c) for c in np.clip(np.array(material.base_color) * gain, *limits))
    return replace(material, base_color=(r, g, b))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Regions:
    """What a small view shows."""

    ids: Int32
    """(H, W) instance, without the rims of objects; -1 = none, or a rim."""
    table: Mask
    """(H, W) the table near the objects."""


def _seen(regions: _Regions, instances: set[int]) -> Mask:
    """Return where (H, W) any of these instances is seen."""
    return np.isin(regions.ids, sorted(instances))


def _annotated(store: SessionStore, view: int, stride: int) -> Int32 | None:
    """Return the instances (H, W) of a real view's visible masks; None = it is not annotated.

    They leave out what something unknown, such as a hand, hides.
    """
    if not store.has(f"annotations/{view:06d}.json"):
        return None
    return label_ids(store, view)[::stride, ::stride]


def _regions(
    synthetic: SyntheticScene,
    labels: Labels,
    camera: CameraIntrinsics,
    T_world_cam: Array,
    annotated: Int32 | None,
) -> _Regions:
    """Return where the objects are seen, without their rims, and the table near them."""
    import cv2

    kernel = np.ones((3, 3), np.uint8)
    ids = np.full(labels.ids.shape, -1, np.int32)
    for instance in np.unique(labels.ids[labels.ids >= 0]).tolist():
        ids[cv2.erode((labels.ids == instance).astype(np.uint8), kernel) > 0] = instance
    if annotated is not None:
        ids[annotated != ids] = -1
    table = (labels.ids < 0) & (labels.depth_m > 0)
    plane = synthetic.scene.plane
    if plane is None:
        return _Regions(ids=ids, table=np.zeros_like(table))
    points = ray_table(camera) * labels.depth_m[..., None]
    T_table_world = se3.invert(plane.T_world_table)
    T_table_cam = T_table_world @ T_world_cam
    on_table = points @ T_table_cam[:2, :3].T + T_table_cam[:2, 3]
    corners = np.concatenate([
        se3.transform(T_table_world @ o.T_world_obj, synthetic.models[o.obj_id].mesh.vertices)
        for o in synthetic.shown
    ])[:, :2]  # fmt: skip
    low, high = corners.min(0) - NEAR_TABLE_M, corners.max(0) + NEAR_TABLE_M
    near = np.all((on_table > low) & (on_table < high), axis=-1)
    apart = cv2.dilate((labels.ids >= 0).astype(np.uint8), kernel) == 0
    return _Regions(ids=ids, table=table & near & np.asarray(apart))


def _rendered(
    look: SyntheticScene, table: Material | None, camera: CameraIntrinsics, Ts: Iterable[Array]
) -> list[Rgb]:
    """Return small noiseless pictures from these places (4, 4)."""
    from realsim.rendering.photo import PhotoRenderer

    placed = [
        PlacedMesh(p.instance, p.mesh, p.T_world_obj, table) if p.instance == BACKGROUND else p
        for p in look.placed()
    ]
    renderer = PhotoRenderer(placed, environment=look.environment)
    return [renderer.render(camera, T).rgb for T in Ts]


def _means(
    photographs: list[Rgb], pictures: list[Rgb], regions: list[Mask], least: int = LEAST_PIXELS
) -> tuple[Array, Array] | None:
    """Return the mean linear colours (3,) of photographs and pictures over regions of them.

    None = the regions have fewer pixels than `least`.
    """
    real = np.concatenate([p[r] for p, r in zip(photographs, regions, strict=True)])
    made = np.concatenate([p[r] for p, r in zip(pictures, regions, strict=True)])
    fine = (real.max(-1) < SATURATED) & (made.max(-1) < SATURATED) if len(real) else []
    if int(np.count_nonzero(fine)) < least:
        # All saturated: the values still say in which direction to go.
        if len(real) < least:
            return None
        fine = np.ones(len(real), np.bool_)
    return light_of_bytes(real[fine]).mean(0), light_of_bytes(made[fine]).mean(0)


def _scaled(environment: Environment, gain: Array) -> Environment:
    """Return the light with each colour scaled."""
    r, g, b = (float(x) for x in np.array(environment.sun) * gain)
    panorama = environment.panorama * gain.astype(np.float32)
    return replace(environment, panorama=panorama, sun=(r, g, b))
