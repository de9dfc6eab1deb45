"""What points of surfaces send to the eye in the soft even room, compiled.

The look is that of `photo.Lighting`: matte under ambient light from above and below and one sun,
with a highlight on objects. Everything is computed in the frame of the mesh that is seen, so that a
mesh that moves is described once.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64, Mask, UInt8, UInt16
from realsim.compiled import njit
from realsim.geometry import se3
from realsim.records import Mesh
from realsim.rendering.embedded.materials import Surface
from realsim.rendering.embedded.surface_table import face_seen, plane_met, smooth_normal
from realsim.rendering.rays import PlacedMesh

MOST_HALVINGS = 16
LIFT_M = 1e-4
"""Points are tested for shadow this far off the surface, or rounding would shade it by itself."""
FAST = {"nsz", "arcp", "contract", "afn", "reassoc"}
"""Freedom of rounding; NaN keeps its meaning."""
STEP = 32.0
"""Steps between two texels, as OpenCV interpolates: both renderers give the same picture."""
GROUND, SKY, SUN, HORIZON, ZENITH, FLOOR, GLOSS = range(7)
"""Rows of the light; the last holds strength and exponent of the highlight."""


class RoomSurfaces(NamedTuple):
    """Faces of G meshes one after another, F in all, each in the frame of its mesh."""

    first_face: Int64
    """(G + 1,) first face of each mesh."""
    corners: Array32
    """(F, 3, 3) [m]."""
    normals: Array32
    """(F, 3, 3) unit shading normals of the corners."""
    paint: Array32
    """(F, 3, 3) linear colours of the corners, or their texture coordinates in the first two."""
    density: Array32
    """(F,) texels per metre."""
    texels: UInt16
    """(T, 3) linear texels of all images and their halvings."""
    layout: Int64
    """(G, MOST_HALVINGS, 3) first texel, rows and columns of each halving."""
    halvings: Int64
    """(G,) number of halvings; 0 = coloured at the corners."""
    wraps: Mask
    """(G,) whether the image repeats; else its border continues."""
    tint: Array32
    """(G, 3) factor of the colour."""
    glossy: Mask
    """(G,) whether there is a highlight."""


class RoomView(NamedTuple):
    """One camera among meshes that stand somewhere, in the frames of the meshes."""

    eyes: Array
    """(G, 3) [m]."""
    Rs_obj_cam: Array
    """(G, 3, 3)."""
    R_world_cam: Array
    """(3, 3)."""
    Ts_sun_obj: Array
    """(G, 4, 4): x and y across the sun's rays, z towards the sun [m]."""
    R_sun_world: Array
    """(3, 3)."""
    light: Array
    """(7, 3) see `GROUND` and the following."""
    suns: Array
    """(G, 3) unit directions to the sun."""
    ups: Array
    """(G, 3) unit directions upwards."""


class RoomSamples(NamedTuple):
    """What N rays see."""

    ambient: Array32
    """(N, 3) linear light without the sun."""
    sunny: Array32
    """(N, 3) what the sun adds where it shines."""
    toward_sun: Array32
    """(N, 3) where the sun's ray is tested, in the sun's frame [m]; NaN = it cannot shine there."""


def room_surfaces(placed: Sequence[PlacedMesh], gamma: float) -> RoomSurfaces:
    """Return the surfaces of placed meshes; where they stand does not matter."""
    # Where nothing is placed, a surface that no ray meets gives the arrays their shapes.
    unseen = Mesh(vertices=np.eye(3), faces=np.array([[0, 1, 2]]))
    placed = placed or [PlacedMesh(0, unseen, np.eye(4))]
    surfaces = [Surface(p, gamma) for p in placed]
    n, first = len(placed), 0
    layout = np.zeros((n, MOST_HALVINGS, 3), np.int64)
    levels: list[UInt16] = []
    known: dict[int, int] = {}
    for g, surface in enumerate(surfaces):
        halvings = surface.texture.levels[:MOST_HALVINGS] if surface.texture else []
        for k, image in enumerate(halvings):
            if id(image) not in known:
                known[id(image)] = first
                levels.append(image.reshape(-1, 3))
                first += len(levels[-1])
            layout[g, k] = known[id(image)], *image.shape[:2]
    counts = [len(p.mesh.faces) for p in placed]
    corners = [p.mesh.vertices[p.mesh.faces] for p in placed]
    texture = [s.texture for s in surfaces]
    return RoomSurfaces(
        first_face=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        corners=np.concatenate(corners).astype(np.float32),
        normals=np.concatenate([s.local_normals for s in surfaces]),
        paint=np.concatenate([s.paint for s in surfaces]),
        density=np.concatenate([s.texels_per_m for s in surfaces]),
        texels=np.concatenate(levels) if levels else np.zeros((1, 3), np.uint16),
        layout=layout,
        halvings=np.array([len(t.levels[:MOST_HALVINGS]) if t else 0 for t in texture], np.int64),
        wraps=np.array([bool(t and t.wrap) for t in texture]),
        tint=np.array([s.tint for s in surfaces], np.float32),
        glossy=np.array([s.is_glossy for s in surfaces]),
    )


def room_view(
    light: Array, R_sun_world: Array, Ts_world_obj: Array, T_world_cam: Array
) -> RoomView:
    """Return a camera at T_world_cam (4, 4) among meshes at Ts_world_obj (G, 4, 4) [m].

    `light` and `R_sun_world` are those of `RoomView`.
    """
    Ts_obj_cam = se3.invert(Ts_world_obj) @ T_world_cam
    Ts_sun_obj = se3.from_rt(R_sun_world, np.zeros(3)) @ Ts_world_obj
    return RoomView(
        eyes=np.ascontiguousarray(Ts_obj_cam[:, :3, 3]),
        Rs_obj_cam=np.ascontiguousarray(Ts_obj_cam[:, :3, :3]),
        R_world_cam=np.ascontiguousarray(T_world_cam[:3, :3]),
        Ts_sun_obj=Ts_sun_obj,
        R_sun_world=R_sun_world,
        light=light,
        suns=np.ascontiguousarray(Ts_sun_obj[:, 2, :3]),
        ups=np.ascontiguousarray(Ts_world_obj[:, 2, :3]),
    )


def empty_samples(n: int) -> RoomSamples:
    """Return buffers for n rays."""
    return RoomSamples(*(np.empty((n, 3), np.float32) for _ in range(3)))


@njit(inline="always", error_model="numpy")
def _texel(
    z: UInt16, layout: Int64, wraps: bool, at: tuple[int, int, float, float]
) -> tuple[float, float, float]:
    """Return one halving's colour at texture coordinates, between the texels' centres."""
    g, k, u, v = at
    first, rows, columns = layout[g, k, 0], layout[g, k, 1], layout[g, k, 2]
    v = 1.0 - v
    if wraps:
        u, v = u - np.floor(u), v - np.floor(v)
    x = np.floor((u * columns - 0.5) * STEP + 0.5) / STEP
    y = np.floor((v * rows - 0.5) * STEP + 0.5) / STEP
    x, y = min(max(x, -1.0), columns - 0.5), min(max(y, -1.0), rows - 0.5)
    c0, r0 = int(np.floor(x)), int(np.floor(y))
    a, b = x - c0, y - r0
    c1, r1 = c0 + 1, r0 + 1
    if wraps:
        c0, c1 = c0 if c0 >= 0 else columns - 1, c1 if c1 < columns else 0
        r0, r1 = r0 if r0 >= 0 else rows - 1, r1 if r1 < rows else 0
    else:
        c0, c1 = min(max(c0, 0), columns - 1), min(max(c1, 0), columns - 1)
        r0, r1 = min(max(r0, 0), rows - 1), min(max(r1, 0), rows - 1)
    p, q = first + r0 * columns + c0, first + r0 * columns + c1
    m, o = first + r1 * columns + c0, first + r1 * columns + c1
    wp, wq, wm, wo = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    return (
        wp * z[p, 0] + wq * z[q, 0] + wm * z[m, 0] + wo * z[o, 0],
        wp * z[p, 1] + wq * z[q, 1] + wm * z[m, 1] + wo * z[o, 1],
        wp * z[p, 2] + wq * z[q, 2] + wm * z[m, 2] + wo * z[o, 2],
    )


@njit(inline="always", error_model="numpy")
def _painted(
    paint: Array32,
    images: tuple[UInt16, Int64, int, bool],
    place: tuple[int, int, float, float, float],
    footprint: float,
) -> tuple[float, float, float]:
    """Return the linear colour of a point of a face before its tint, averaged over a footprint.

    Args:
        paint: see `RoomSurfaces`.
        images: texels, layout, the number of halvings of the mesh, whether they repeat.
        place: mesh, face, and the weights of its corners.
        footprint: [texels].
    """
    texels, layout, halvings, wraps = images
    g, f, a, b, w = place
    x = a * paint[f, 0, 0] + b * paint[f, 1, 0] + w * paint[f, 2, 0]
    y = a * paint[f, 0, 1] + b * paint[f, 1, 1] + w * paint[f, 2, 1]
    if halvings == 0:
        return x, y, a * paint[f, 0, 2] + b * paint[f, 1, 2] + w * paint[f, 2, 2]
    level = 0.0
    if footprint > 1.0:
        level = min(np.log2(footprint), halvings - 1.0)
    k = int(level)
    mix = level - k
    red, green, blue = _texel(texels, layout, wraps, (g, k, x, y))
    if mix > 0.0:
        x, y, z = _texel(texels, layout, wraps, (g, k + 1, x, y))
        red, green, blue = red + mix * (x - red), green + mix * (y - green), blue + mix * (z - blue)
    return red / 65535.0, green / 65535.0, blue / 65535.0


@njit(inline="always", error_model="numpy")
def _fill_background(light: Array, up: float, out: Array32, n: int) -> None:
    """Fill row n with the room behind everything, by the elevation of the ray."""
    rise, fall = np.sqrt(max(up, 0.0)), np.sqrt(max(-up, 0.0))
    for k in range(3):
        h = light[HORIZON, k]
        out[n, k] = h + rise * (light[ZENITH, k] - h) + fall * (light[FLOOR, k] - h)


@njit(error_model="numpy", fastmath=FAST, allocates=False)
def sample_room(
    s: RoomSurfaces,
    view: RoomView,
    rays: Array32,
    hits: tuple[Int32, Int32],
    rows: Int64,
    pixel_rad: float,
    out: RoomSamples,
) -> None:
    """Fill what rays see, the sun's part apart.

    Args:
        s: the surfaces.
        view: the camera.
        rays: (P, 3) in camera axes, z = 1; NaN = no ray, which is black.
        hits: placed mesh (P,), -1 = nothing, and its face (P,).
        rows: (N,) which of them.
        pixel_rad: what each stands for [rad].
        out: buffers of N rows.
    """
    geometry, face = hits
    light, R, T, suns, ups = view.light, view.Rs_obj_cam, view.Ts_sun_obj, view.suns, view.ups
    R_world_cam, eyes, first_face, corners = view.R_world_cam, view.eyes, s.first_face, s.corners
    normals, painted, density, texels = s.normals, s.paint, s.density, s.texels
    layout, halvings, wraps, tint, glossy = s.layout, s.halvings, s.wraps, s.tint, s.glossy
    ambient, sunny, toward_sun = out.ambient, out.sunny, out.toward_sun
    f, eye = -1, (eyes[0, 0], eyes[0, 1], eyes[0, 2])
    e, o, q, normal = face_seen(corners, 0, eye)
    for n in range(len(rows)):
        i = rows[n]
        toward_sun[n, 0] = np.nan
        for k in range(3):
            ambient[n, k] = sunny[n, k] = 0.0
        u, v = float(rays[i, 0]), float(rays[i, 1])
        if np.isnan(u):
            continue
        length, g = np.sqrt(u * u + v * v + 1.0), int(geometry[i])
        if g < 0:
            up = R_world_cam[2, 0] * u + R_world_cam[2, 1] * v + R_world_cam[2, 2]
            _fill_background(light, up / length, ambient, n)
            continue
        x, y, z = (
            R[g, 0, 0] * u + R[g, 0, 1] * v + R[g, 0, 2],
            R[g, 1, 0] * u + R[g, 1, 1] * v + R[g, 1, 2],
            R[g, 2, 0] * u + R[g, 2, 1] * v + R[g, 2, 2],
        )
        if f != first_face[g] + face[i]:  # neighbours are often on one face
            f, eye = int(first_face[g] + face[i]), (eyes[g, 0], eyes[g, 1], eyes[g, 2])
            e, o, q, normal = face_seen(corners, f, eye)
        b, w, t = plane_met(e, o, q, (x, y, z))
        b, w = min(max(b, 0.0), 1.0), min(max(w, 0.0), 1.0)
        a, (fx, fy, fz) = max(1.0 - b - w, 0.0), normal
        if fx * x + fy * y + fz * z > 0.0:  # an open surface is lit from the side it is seen from
            fx, fy, fz = -fx, -fy, -fz
        nx, ny, nz = smooth_normal(normals, f, (a, b, w), (fx, fy, fz))
        sx, sy, sz = suns[g, 0], suns[g, 1], suns[g, 2]
        images = (texels, layout, int(halvings[g]), bool(wraps[g]))
        paint = _painted(painted, images, (g, f, a, b, w), t * pixel_rad * float(density[f]))
        paint = (paint[0] * tint[g, 0], paint[1] * tint[g, 1], paint[2] * tint[g, 2])
        up = 0.5 + 0.5 * (nx * ups[g, 0] + ny * ups[g, 1] + nz * ups[g, 2])
        for k in range(3):
            low = light[GROUND, k]
            ambient[n, k] = paint[k] * (low + up * (light[SKY, k] - low))
        facing = nx * sx + ny * sy + nz * sz
        if facing <= 0.0 or fx * sx + fy * sy + fz * sz <= 0.0:
            continue
        px, py, pz = (
            eye[0] + t * x + LIFT_M * fx,
            eye[1] + t * y + LIFT_M * fy,
            eye[2] + t * z + LIFT_M * fz,
        )
        for k in range(3):
            along = T[g, k, 0] * px + T[g, k, 1] * py + T[g, k, 2] * pz
            toward_sun[n, k] = along + T[g, k, 3]
        shine = 0.0
        if glossy[g] and light[GLOSS, 0] > 0.0:
            hx, hy, hz = sx - x / length, sy - y / length, sz - z / length
            size = max(np.sqrt(hx * hx + hy * hy + hz * hz), 1e-12)
            along = max((hx * nx + hy * ny + hz * nz) / size, 0.0)
            shine = light[GLOSS, 0] * along ** light[GLOSS, 1]
        for k in range(3):
            sunny[n, k] = light[SUN, k] * (facing * paint[k] + shine)


@njit(error_model="numpy")
def sun_rays(toward_sun: Array32, R: Array32) -> tuple[Array32, Int64]:
    """Return rays (M, 6) to the sun from where it may shine, and their rows; R (3, 3) sun-world."""
    rows = np.flatnonzero(~np.isnan(toward_sun[:, 0]))
    rays = np.empty((len(rows), 6), np.float32)
    for m in range(len(rows)):
        x, y, z = toward_sun[rows[m]]
        for k in range(3):
            rays[m, k], rays[m, 3 + k] = x * R[0, k] + y * R[1, k] + z * R[2, k], R[2, k]
    return rays, rows


@njit(error_model="numpy", fastmath=FAST)
def lit_colors(samples: RoomSamples, lit: Mask) -> Array32:
    """Return the light (N, 3) of samples, the sun's part where it shines."""
    out = np.empty_like(samples.ambient)
    for i in range(len(out)):
        for k in range(3):
            out[i, k] = samples.ambient[i, k] + (samples.sunny[i, k] if lit[i] else 0.0)
    return out


@njit(error_model="numpy", fastmath=FAST)
def mean_colors(samples: RoomSamples, lit: Mask, parts: int, rows: Int64, out: Array32) -> None:
    """Fill the pixels `rows` (M,) of a picture (P, 3) with the light of their parts (M * parts)."""
    for m in range(len(rows)):
        for k in range(3):
            total = 0.0
            for i in range(m * parts, (m + 1) * parts):
                total += samples.ambient[i, k] + (samples.sunny[i, k] if lit[i] else 0.0)
            out[rows[m], k] = total / parts


@njit(error_model="numpy", fastmath=FAST)
def tones(color: Array32, gamma: float, rows: Int64, out: Array32) -> None:
    """Fill the encoded brightness `out` (P,) of the pixels `rows` of a picture (P, 3).

    Between its values at 4096 steps: what is compared are differences of a few percent.
    """
    steps = (np.arange(4098) / 4096.0) ** (1.0 / gamma)
    for n in range(len(rows)):
        i = rows[n]
        at = min(max((color[i, 0] + color[i, 1] + color[i, 2]) / 3.0, 0.0), 1.0) * 4096.0
        k = int(at)
        out[i] = steps[k] + (at - k) * (steps[k + 1] - steps[k])


def busy_among(tone: Array32, geometry: Int32, contrast: float) -> Mask:
    """Return (H, W) which pixels have contrast or the edge of a mesh within 3 x 3 pixels.

    `tone` is (P,), `geometry` (H, W).
    """
    import cv2

    around, meshes = np.ones((3, 3), np.uint8), geometry.astype(np.float32)
    tone = tone.reshape(geometry.shape)
    edges = cv2.dilate(meshes, around) != cv2.erode(meshes, around)
    return edges | (cv2.dilate(tone, around) - cv2.erode(tone, around) > contrast)


@njit(error_model="numpy", fastmath=FAST)
def encoded(color: Array32, gamma: float) -> UInt8:
    """Return the encoded picture (P, 3) of linear light: round(255 v^(1 / gamma)).

    Looked up between the 255 values at which the rounding changes.
    """
    steps = np.empty(257)
    for k in range(257):
        steps[k] = ((k - 0.5) / 255.0) ** gamma if k > 0 else -1.0
    steps[256] = np.inf
    first, k = np.empty(4097, np.int64), 0
    for j in range(4097):
        while steps[k + 1] <= j / 4096.0:
            k += 1
        first[j] = k
    out = np.empty(color.shape, np.uint8)
    for i in range(len(color)):
        for c in range(3):
            value = min(max(float(color[i, c]), 0.0), 1.0)
            k = first[int(value * 4096.0)]
            while steps[k + 1] <= value:
                k += 1
            out[i, c] = k
    return out
