"""The surfaces of a scene as arrays: what lies under a ray, its normals and its material there.

Geometry of one face under a ray: where it is met, how it is rounded, how its normal bends.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64, Rows
from realsim.compiled import njit
from realsim.geometry import se3
from realsim.geometry.colors import srgb_decoded
from realsim.rendering.appearance import LEAST_ROUGHNESS
from realsim.rendering.embedded.materials import box_uv, corner_normals, look_of, repeats
from realsim.rendering.embedded.texture_atlas import (
    MOST_PROBES,
    TextureArrays,
    TextureAtlas,
    bent_normal,
    color_at,
    detail_at,
    footprint,
)
from realsim.rendering.rays import PlacedMesh

Edges = tuple[float, float, float, float, float, float]
"""The two edges of a face from its first corner [m]."""
Point = tuple[float, float, float]


@njit(inline="always", error_model="numpy")
def edges_of(corners: Array32, f: int) -> Edges:
    """Return the two edges of face f from its first corner."""
    x, y, z = corners[f, 0, 0], corners[f, 0, 1], corners[f, 0, 2]
    return (
        corners[f, 1, 0] - x, corners[f, 1, 1] - y, corners[f, 1, 2] - z,
        corners[f, 2, 0] - x, corners[f, 2, 1] - y, corners[f, 2, 2] - z,
    )  # fmt: skip


@njit(inline="always", error_model="numpy")
def face_seen(corners: Array32, f: int, eye: Point) -> tuple[Edges, Point, Point, Point]:
    """Return of face f as seen from a point: its edges, o and q of `plane_met`, its unit normal."""
    e = edges_of(corners, f)
    o = (eye[0] - corners[f, 0, 0], eye[1] - corners[f, 0, 1], eye[2] - corners[f, 0, 2])
    q = (o[1] * e[2] - o[2] * e[1], o[2] * e[0] - o[0] * e[2], o[0] * e[1] - o[1] * e[0])
    x, y, z = e[1] * e[5] - e[2] * e[4], e[2] * e[3] - e[0] * e[5], e[0] * e[4] - e[1] * e[3]
    size = max(np.sqrt(x * x + y * y + z * z), 1e-30)
    return e, o, q, (x / size, y / size, z / size)


@njit(inline="always", error_model="numpy")
def weighted(values: Array32, f: int, weights: Point) -> Point:
    """Return what a point of face f has by its corners' values (F, 3, 3)."""
    a, b, w = weights
    return (
        a * values[f, 0, 0] + b * values[f, 1, 0] + w * values[f, 2, 0],
        a * values[f, 0, 1] + b * values[f, 1, 1] + w * values[f, 2, 1],
        a * values[f, 0, 2] + b * values[f, 1, 2] + w * values[f, 2, 2],
    )


@njit(inline="always", error_model="numpy")
def smooth_normal(normals: Array32, f: int, weights: Point, flat: Point) -> Point:
    """Return the unit shading normal at a point of face f, on the side of its normal."""
    x, y, z = weighted(normals, f, weights)
    size = max(np.sqrt(x * x + y * y + z * z), 1e-12)
    size = size if x * flat[0] + y * flat[1] + z * flat[2] >= 0.0 else -size
    return x / size, y / size, z / size


@njit(inline="always", error_model="numpy")
def plane_met(e: Edges, o: Point, q: Point, d: Point) -> Point:
    """Return the weights of the second and third corner, and t, where a ray meets a plane.

    Moller and Trumbore, "Fast, minimum storage ray/triangle intersection", 1997.

    Args:
        e: the two edges from the first corner.
        o: origin of the ray minus the first corner.
        q: o x first edge.
        d: direction of the ray.
    """
    x, y, z = d
    px, py, pz = y * e[5] - z * e[4], z * e[3] - x * e[5], x * e[4] - y * e[3]
    det = e[0] * px + e[1] * py + e[2] * pz
    safe = det if abs(det) > 1e-30 else 1e-30
    u = (o[0] * px + o[1] * py + o[2] * pz) / safe
    v = (x * q[0] + y * q[1] + z * q[2]) / safe
    return u, v, (e[3] * q[0] + e[4] * q[1] + e[5] * q[2]) / safe


@njit(inline="always", error_model="numpy")
def bulge_of(e: Edges, m: Array32, weights: tuple[float, float, float]) -> float:
    """Return how high the rounded surface stands above a point of the face; 0 in hollows.

    The mean of the heights of the corners' tangent planes (Hanika, "Hacking the shadow
    terminator", Ray Tracing Gems II, 2021): rays to the sun that start there do not show the facets
    of the mesh.

    Args:
        e: the two edges from the first corner.
        m: normals of the corners.
        weights: of the corners.
    """
    a, b, w = weights
    px, py, pz = b * e[0] + w * e[3], b * e[1] + w * e[4], b * e[2] + w * e[5]
    height = a * max(-(px * m[0, 0] + py * m[0, 1] + pz * m[0, 2]), 0.0)
    qx, qy, qz = px - e[0], py - e[1], pz - e[2]
    height += b * max(-(qx * m[1, 0] + qy * m[1, 1] + qz * m[1, 2]), 0.0)
    qx, qy, qz = px - e[3], py - e[4], pz - e[5]
    return height + w * max(-(qx * m[2, 0] + qy * m[2, 1] + qz * m[2, 2]), 0.0)


SAME_DIRECTION = 0.98
"""Cosine of normals (11 deg) within which a part of a pixel is what its centre is."""
WIDEST_FOOTPRINT = 4.0
"""Footprints end at so many tiles of the texture: rays that graze a face have no finite one."""


class SurfaceArrays(NamedTuple):
    """Faces of all placed meshes one after another, G meshes, F faces."""

    first_face: Int64
    """(G + 1,) first face of each mesh."""
    corners: Array32
    """(F, 3, 3) in world, relative to the scene's centre [m]."""
    normals: Array32
    """(F, 3, 3) unit shading normals of the corners, world."""
    uv: Array32
    """(F, 3, 2) texture coordinates; zeros where there is no image."""
    colors: Array32
    """(C, 3, 3) linear colours of the corners of meshes with vertex colours."""
    first_color: Int64
    """(G,) row of the mesh's first face in `colors`; -1 = none."""
    base: Array32
    """(G, 3) linear base colour."""
    roughness: Array32
    """(G,)."""
    metallic: Array32
    """(G,)."""
    images: Int64
    """(G, 3) numbers of the images of base colour, roughness and normals; -1 = none."""
    mean_color: Array32
    """(G, 3) linear base colour, averaged over the mesh: what it sends back to its neighbours."""


class SurfacePoints(NamedTuple):
    """What N rays see: one row per ray; rows without a hit stay zero."""

    position: Array
    """(N, 3) in world [m]."""
    flat: Array32
    """(N, 3) unit normal of the face, towards the eye."""
    smooth: Array32
    """(N, 3) unit interpolated normal."""
    normal: Array32
    """(N, 3) unit normal for shading: interpolated, and bent by the normal image."""
    base: Array32
    """(N, 3) linear base colour."""
    roughness: Array32
    """(N,) widened where the normal turns within the pixel."""
    metallic: Array32
    """(N,)."""
    bulge: Array32
    """(N,) height of the rounded surface that the normals tell of above the flat face [m]."""


def empty_points(n: int) -> SurfacePoints:
    """Return buffers for n rays."""
    rows = [np.zeros((n, 3), np.float32) for _ in range(4)]
    flat, smooth, normal, base = rows
    rough, metal, bulge = np.ones(n, np.float32), np.zeros(n, np.float32), np.zeros(n, np.float32)
    return SurfacePoints(np.zeros((n, 3)), flat, smooth, normal, base, rough, metal, bulge)


def surface_arrays(
    placed: Sequence[PlacedMesh], center: Array
) -> tuple[SurfaceArrays, TextureArrays]:
    """Return the surfaces and images of placed meshes, coordinates relative to `center` (3,)."""
    atlas = TextureAtlas()
    rows = [_one_surface(k, p, center, atlas) for k, p in enumerate(placed)]
    counts = [len(p.mesh.faces) for p in placed]
    with_colors = [r["colors"] for r in rows if r["colors"] is not None]
    first_color, n = [], 0
    for r in rows:
        first_color.append(n if r["colors"] is not None else -1)
        n += 0 if r["colors"] is None else len(r["colors"])

    def joined(name: str, shape: tuple[int, ...]) -> Array32:
        parts = [r[name] for r in rows]
        return np.concatenate(parts) if parts else np.zeros((0, *shape), np.float32)

    def listed(name: str, shape: tuple[int, ...]) -> Array32:
        return np.array([r[name] for r in rows], np.float32).reshape(len(rows), *shape)

    surfaces = SurfaceArrays(
        first_face=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        corners=joined("corners", (3, 3)),
        normals=joined("normals", (3, 3)),
        uv=joined("uv", (3, 2)),
        colors=np.concatenate(with_colors) if with_colors else np.zeros((1, 3, 3), np.float32),
        first_color=np.array(first_color, np.int64),
        base=listed("base", (3,)),
        roughness=listed("roughness", ()),
        metallic=listed("metallic", ()),
        images=np.array([r["images"] for r in rows], np.int64).reshape(-1, 3),
        mean_color=listed("mean_color", (3,)),
    )
    return surfaces, atlas.arrays()


def _one_surface(
    number: int, placed: PlacedMesh, center: Array, atlas: TextureAtlas
) -> dict[str, Any]:
    """Return the rows of one mesh by the names of `SurfaceArrays`."""
    mesh = placed.mesh
    world = se3.transform(placed.T_world_obj, mesh.vertices) - center
    R = placed.T_world_obj[:3, :3].astype(np.float32)
    material, painted = look_of(number, placed)
    uv, wraps = np.zeros((len(mesh.faces), 3, 2), np.float32), painted is None
    if material.projection == "uv":
        assert mesh.uv is not None
        uv, wraps = mesh.uv[mesh.faces].astype(np.float32), repeats(mesh.uv)
    elif painted is None:
        uv = box_uv(mesh, material.period_m)
    normal, rough = atlas.add_detail(material.normal_image, material.roughness_image, wrap=wraps)
    images = (atlas.add_color(material.base_color_image, wrap=wraps), rough, normal)
    base = np.array(material.base_color, np.float32)
    colors: Array32 | None = None
    mean = base * (atlas.mean_color(images[0]) if images[0] >= 0 else 1.0)
    if painted is not None:
        linear = srgb_decoded(np.arange(256) / 255.0).astype(np.float32)[painted]
        colors = linear[mesh.faces]
        mean = linear.mean(0)
    return {
        "corners": world[mesh.faces].astype(np.float32),
        "normals": corner_normals(mesh) @ R.T,
        "uv": uv,
        "colors": colors,
        "base": base,
        "roughness": material.roughness,
        "metallic": material.metallic,
        "images": images,
        "mean_color": mean,
    }


def fill_points(
    surfaces: SurfaceArrays,
    images: TextureArrays,
    rays: tuple[Array, Array, Array32, Array32, Array32],
    hits: tuple[Int32, Int32],
    out: SurfacePoints,
    pixels: tuple[SurfacePoints, Int32, Rows] | None = None,
) -> None:
    """Fill the surface points of rays.

    Args:
        surfaces: the surfaces.
        images: their images.
        rays: eye (3,) and centre of the scene (3,) in world [m], directions (N, 3), and their
            change over the pixel's width and height (N, 3) each.
        hits: placed mesh (N,), -1 = none, and face of that mesh (N,) of each ray.
        out: buffers of N rows.
        pixels: where the rays are parts of pixels: what these see, their mesh, and the pixel (N,)
            of each ray. A ray on its pixel's own face direction has the pixel's material, which is
            averaged over the pixel already.
    """
    places = np.empty((len(hits[0]), 7), np.float32)
    _fill_geometry(surfaces, rays, hits, out, places)
    if pixels is not None:
        hits = (borrow_materials(pixels, hits[0], out), hits[1])
    _fill_materials(surfaces, images, hits, places, out)


@njit(error_model="numpy")
def _fill_geometry(
    s: SurfaceArrays,
    rays: tuple[Array, Array, Array32, Array32, Array32],
    hits: tuple[Int32, Int32],
    out: SurfacePoints,
    places: Array32,
) -> None:
    """Fill positions and normals, and where in its face each point lies.

    `places` (N, 7): weights of the face's second and third corner; how they change over the
    pixel's width (2) and height (2); how much the normal turns within the pixel, squared.
    """
    eye, center, directions, along_u, along_v = rays
    seen_from = (eye[0] - center[0], eye[1] - center[1], eye[2] - center[2])
    geometry, face = hits
    for i in range(len(geometry)):
        if geometry[i] < 0:
            continue
        f = s.first_face[geometry[i]] + face[i]
        e, o, q, (nx, ny, nz) = face_seen(s.corners, f, seen_from)
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        b, w, t = plane_met(e, o, q, (x, y, z))
        # The footprint: where the rays of the next pixels meet the plane of the face.
        du = (x + along_u[i, 0], y + along_u[i, 1], z + along_u[i, 2])
        dv = (x + along_v[i, 0], y + along_v[i, 1], z + along_v[i, 2])
        bu, wu, _ = plane_met(e, o, q, du)
        bv, wv, _ = plane_met(e, o, q, dv)
        bu, wu, bv, wv = bu - b, wu - w, bv - b, wv - w
        b, w = min(max(b, 0.0), 1.0), min(max(w, 0.0), 1.0)
        places[i, 0], places[i, 1] = b, w
        places[i, 2], places[i, 3], places[i, 4], places[i, 5] = bu, wu, bv, wv

        if nx * x + ny * y + nz * z > 0:
            nx, ny, nz = -nx, -ny, -nz
        out.flat[i, 0], out.flat[i, 1], out.flat[i, 2] = nx, ny, nz
        m = s.normals[f]
        a = max(1.0 - b - w, 0.0)
        sx, sy, sz = smooth_normal(s.normals, f, (a, b, w), (nx, ny, nz))
        out.smooth[i, 0], out.smooth[i, 1], out.smooth[i, 2] = sx, sy, sz
        turn = 0.0
        for k in range(3):
            out.position[i, k] = eye[k] + t * directions[i, k]
            out.normal[i, k] = out.smooth[i, k]
            d1, d2 = m[1, k] - m[0, k], m[2, k] - m[0, k]
            turn += (d1 * bu + d2 * wu) ** 2 + (d1 * bv + d2 * wv) ** 2
        places[i, 6] = turn
        out.bulge[i] = bulge_of(e, m, (a, b, w)) if turn > 0 else 0.0


@njit(error_model="numpy")
def borrow_materials(
    pixels: tuple[SurfacePoints, Int32, Rows], geometry: Int32, out: SurfacePoints
) -> Int32:
    """Fill the materials of rays on their pixel's surface; return the mesh (N,) of the others.

    See `fill_points`; -1 = nothing is left to look up.
    """
    theirs, mesh, owner = pixels
    left = geometry.copy()
    for m in range(len(geometry)):
        i = owner[m]
        if geometry[m] < 0 or mesh[i] != geometry[m]:
            continue
        turn = 0.0
        for k in range(3):
            turn += out.smooth[m, k] * theirs.smooth[i, k]
        if turn < SAME_DIRECTION:
            continue
        left[m] = -1
        length = 1e-12
        for k in range(3):
            out.base[m, k] = theirs.base[i, k]
            bent = theirs.normal[i, k] + out.smooth[m, k] - theirs.smooth[i, k]
            out.normal[m, k] = bent
            length += bent * bent
        for k in range(3):
            out.normal[m, k] /= np.sqrt(length)
        out.roughness[m], out.metallic[m] = theirs.roughness[i], theirs.metallic[i]
    return left


@njit(inline="always", error_model="numpy")
def _capped(value: float) -> float:
    """Return a change of texture coordinates of finite size."""
    return min(max(value, -WIDEST_FOOTPRINT), WIDEST_FOOTPRINT)


@njit(error_model="numpy")
def _fill_materials(
    s: SurfaceArrays,
    tex: TextureArrays,
    hits: tuple[Int32, Int32],
    places: Array32,
    out: SurfacePoints,
) -> None:
    """Fill the materials at `places` (see `_fill_geometry`); bend normals by the normal images.

    Normals that turn within the pixel widen the highlight (Tokuyoshi and Kaplanyan, "Improved
    geometric specular antialiasing", I3D 2019); else it sparkles.
    """
    geometry, face = hits
    for i in range(len(geometry)):
        g = geometry[i]
        if g < 0:
            continue
        b, w, turn = places[i, 0], places[i, 1], places[i, 6]
        red, green, blue = s.base[g, 0], s.base[g, 1], s.base[g, 2]
        rough = s.roughness[g]
        if s.first_color[g] >= 0:
            weights = (max(1.0 - b - w, 0.0), b, w)
            r, gr, bl = weighted(s.colors, s.first_color[g] + face[i], weights)
            red, green, blue = red * r, green * gr, blue * bl
        if s.images[g, 0] >= 0 or s.images[g, 1] >= 0 or s.images[g, 2] >= 0:
            f = s.first_face[g] + face[i]
            p, q = s.uv[f, 0, 0], s.uv[f, 0, 1]
            ux, uy = s.uv[f, 1, 0] - p, s.uv[f, 1, 1] - q
            vx, vy = s.uv[f, 2, 0] - p, s.uv[f, 2, 1] - q
            at = (p + b * ux + w * vx, q + b * uy + w * vy)
            bu, wu, bv, wv = places[i, 2], places[i, 3], places[i, 4], places[i, 5]
            du = (_capped(bu * ux + wu * vx), _capped(bu * uy + wu * vy))
            dv = (_capped(bv * ux + wv * vx), _capped(bv * uy + wv * vy))
            i0, i1, i2 = s.images[g, 0], s.images[g, 1], s.images[g, 2]
            if i0 >= 0:
                r, gr, bl = color_at(tex, i0, at, footprint(tex, i0, du, dv, MOST_PROBES))
                red, green, blue = red * r, green * gr, blue * bl
            bend = (0.5, 0.5, 1.0, 1.0)
            if i2 >= 0:
                bend = detail_at(tex, i2, at, footprint(tex, i2, du, dv, 1)[3])
            if i1 >= 0:
                if i1 != i2:
                    rough *= detail_at(tex, i1, at, footprint(tex, i1, du, dv, 1)[3])[3]
                else:
                    rough *= bend[3]
            if i2 >= 0:
                n = (out.smooth[i, 0], out.smooth[i, 1], out.smooth[i, 2])
                x, y, z, more = bent_normal(n, edges_of(s.corners, f), (ux, uy, vx, vy), bend)
                out.normal[i, 0], out.normal[i, 1], out.normal[i, 2] = x, y, z
                turn += more
        out.base[i, 0], out.base[i, 1], out.base[i, 2] = red, green, blue
        rough = min(max(rough, LEAST_ROUGHNESS), 1.0)
        rough = rough * rough * rough * rough + min(0.5 * turn, 0.18)
        out.roughness[i] = np.sqrt(np.sqrt(min(rough, 1.0)))
        out.metallic[i] = s.metallic[g]
