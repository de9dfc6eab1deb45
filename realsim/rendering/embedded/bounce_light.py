"""Light on its last way to a surface: through gaps in what stands around, or off a neighbour.

Few rays, shared by neighbours: each cell of pixels casts other members of one low-discrepancy set,
partly spread by the cosine, partly aimed at what is bright in the sky; a filter that stops at edges
gathers those of a window. Nothing here is random: the same view gives the same light.
"""

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64, Mask
from realsim.compiled import njit
from realsim.rendering.embedded import sky_light
from realsim.rendering.embedded.surface_table import SurfaceArrays, SurfacePoints, weighted
from realsim.rendering.embedded.texture_atlas import TextureArrays, color_at, footprint

BUMPS_UNTIL = 0.25
"""Roughness from which reflected rays do not follow the normal image."""
NEIGHBOUR_OPENNESS = 0.7
"""Share of the sky that neighbours see themselves, on average: it is not traced."""


@njit(inline="always", error_model="numpy")
def shared_pair(pixel: int, width: int, k: int, n: int) -> tuple[float, float]:
    """Return two numbers in [0, 1) for ray k of n of a pixel.

    A lattice over the image by the powers of the root of x^5 = x + 1 (Roberts, "The unreasonable
    effectiveness of quasirandom sequences", 2018): any window of pixels gets an even share of the
    square. The rays of one pixel are a golden-section lattice.
    """
    y, x = pixel // width, pixel - width * (pixel // width)
    a = 0.8566748838545029 * x + 0.733891856627126 * y + k / n
    b = 0.6287067210378087 * x + 0.5385972572236101 * y + k * 0.6180339887498949
    return a - np.floor(a), b - np.floor(b)


@njit(inline="always", error_model="numpy")
def _axes(x: float, y: float, z: float) -> tuple[float, float, float, float, float, float]:
    """Return two unit vectors across a unit vector (Duff et al., JCGT 2017)."""
    s = 1.0 if z >= 0 else -1.0
    a = -1.0 / (s + z)
    b = x * y * a
    return 1.0 + s * x * x * a, s * b, -s * x, b, s + y * y * a, -y


@njit(inline="always", error_model="numpy")
def _leave(
    points: SurfacePoints,
    i: int,
    d: tuple[float, float, float],
    lift: float,
    rays: tuple[Array, Array32],
    j: int,
) -> None:
    """Fill ray `j` from point `i` in a direction; one that goes below the face is mirrored up."""
    origins, directions = rays
    fx, fy, fz = points.flat[i, 0], points.flat[i, 1], points.flat[i, 2]
    below = min(d[0] * fx + d[1] * fy + d[2] * fz - 1e-3, 0.0)
    for k in range(3):
        directions[j, k] = d[k] - 2 * below * points.flat[i, k]
        origins[j, k] = points.position[i, k] + lift * points.flat[i, k]


@njit(error_model="numpy")
def ambient_rays(
    sky: sky_light.SkyArrays,
    points: SurfacePoints,
    cells: tuple[Int64, int, int],
    lift: float,
    rays: tuple[Array, Array32, Array32],
) -> None:
    """Fill rays (M * n) that are spread by the cosine about the normals or aimed at the lamps.

    Args:
        sky: with its lamps.
        points: (N rows) what is seen.
        cells: numbers of the cells (M,) = rows of `points`, cells in a row, rays per cell n.
        lift: distance of the origins from the surface [m].
        rays: origins (M * n, 3), directions (M * n, 3) and weights (M * n,), mean 1; are filled.
    """
    rows, width, n = cells
    origins, directions, weights = rays
    for m in range(len(rows)):
        i = rows[m]
        sx, sy, sz = points.smooth[i, 0], points.smooth[i, 1], points.smooth[i, 2]
        ax, ay, az, bx, by, bz = _axes(sx, sy, sz)
        for k in range(n):
            u1, u2 = shared_pair(i, width, k, n)
            j = m * n + k
            aimed = u1 < sky.lamp_rays
            if aimed:
                x, y, z = sky_light.lamp_direction(sky, u1 / sky.lamp_rays, u2)
            else:
                u1 = (u1 - sky.lamp_rays) / (1.0 - sky.lamp_rays)
                radius, phi = np.sqrt(u1), 2 * np.pi * u2
                p, q, h = radius * np.cos(phi), radius * np.sin(phi), np.sqrt(1 - u1)
                x = p * ax + q * bx + h * sx
                y = p * ay + q * by + h * sy
                z = p * az + q * bz + h * sz
            weights[j] = sky_light.ray_weight(sky, (x, y, z), x * sx + y * sy + z * sz)
            # It may be below the face although above the interpolated surface.
            _leave(points, i, (x, y, z), lift, (origins, directions), j)


@njit(error_model="numpy")
def sun_rays(
    sky: sky_light.SkyArrays,
    points: SurfacePoints,
    which: tuple[Int64, Int64, int, int],
    lift: float,
    rays: tuple[Array, Array32],
) -> None:
    """Fill origins and directions (M, 3) of rays to the sun's disk.

    Args:
        sky: with the sun.
        points: what is seen.
        which: rows (M,) of `points`; the pixel of every row (N,); rows of one pixel, which follow
            one another; width of the image.
        lift: distance of the origins from the surface [m].
        rays: origins and directions; are filled.
    """
    rows, pixel, count, width = which
    origins, directions = rays
    sx, sy, sz = sky.sun_direction
    ax, ay, az, bx, by, bz = _axes(sx, sy, sz)
    size = np.tan(sky.sun_radius)
    for m in range(len(rows)):
        i = rows[m]
        u1, u2 = shared_pair(int(pixel[i]), width, i % count, count)
        p = size * np.sqrt(u1) * np.cos(2 * np.pi * u2)
        q = size * np.sqrt(u1) * np.sin(2 * np.pi * u2)
        directions[m, 0] = sx + p * ax + q * bx
        directions[m, 1] = sy + p * ay + q * by
        directions[m, 2] = sz + p * az + q * bz
        for k in range(3):
            up = lift * points.flat[i, k] + points.bulge[i] * points.smooth[i, k]
            origins[m, k] = points.position[i, k] + up


@njit(error_model="numpy")
def mirror_rays(
    points: SurfacePoints, rows: Int64, eye: Array, lift: float, rays: tuple[Array, Array32]
) -> None:
    """Fill origins and directions (M, 3) of the reflected rays of the points `rows` (M,).

    The lobe of a rough point is wider than the bumps of its normal image turn it: there one ray
    about the bent normal would only be noise, and the ray is that of the smooth surface.
    """
    for m in range(len(rows)):
        i = rows[m]
        x, y, z = points.position[i] - eye
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        even = min(points.roughness[i] / BUMPS_UNTIL, 1.0)
        nx = points.normal[i, 0] + even * (points.smooth[i, 0] - points.normal[i, 0])
        ny = points.normal[i, 1] + even * (points.smooth[i, 1] - points.normal[i, 1])
        nz = points.normal[i, 2] + even * (points.smooth[i, 2] - points.normal[i, 2])
        length = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-9)
        nx, ny, nz = nx / length, ny / length, nz / length
        along = 2 * (x * nx + y * ny + z * nz)
        x, y, z = x - along * nx, y - along * ny, z - along * nz
        _leave(points, i, (x, y, z), lift, rays, m)


@njit(error_model="numpy")
def face_light(sky: sky_light.SkyArrays, surfaces: SurfaceArrays, out: Array32) -> None:
    """Fill what each face sends on (F, 6): under the open sky, and added where the sun shines."""
    for g in range(len(surfaces.base)):
        for f in range(surfaces.first_face[g], surfaces.first_face[g + 1]):
            c = surfaces.corners[f]
            ux, uy, uz = c[1, 0] - c[0, 0], c[1, 1] - c[0, 1], c[1, 2] - c[0, 2]
            vx, vy, vz = c[2, 0] - c[0, 0], c[2, 1] - c[0, 1], c[2, 2] - c[0, 2]
            x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            length = max(np.sqrt(x * x + y * y + z * z), 1e-30)
            x, y, z = x / length, y / length, z / length
            light = sky_light.map_at(sky.irradiance, 0, x, y, z)
            s = sky.sun_direction
            facing = max(x * s[0] + y * s[1] + z * s[2], 0.0)
            for k in range(3):
                out[f, k] = surfaces.mean_color[g, k] * NEIGHBOUR_OPENNESS * light[k]
                out[f, 3 + k] = surfaces.mean_color[g, k] * facing * sky.sun[k]


@njit(error_model="numpy")
def gather_ambient(
    sky: sky_light.SkyArrays,
    face_radiance: Array32,
    rays: tuple[Array32, Array32, Int32, Mask],
    cells: tuple[Int64, int],
    out: Array32,
) -> None:
    """Average what the ambient rays of each cell met.

    Args:
        sky: the sky.
        face_radiance: (F, 6) of `face_light`.
        rays: directions (M * n, 3), weights (M * n,), face in the scene (M * n,) or -1 = sky,
            whether the sun shines on that face there (M * n,).
        cells: rows of `out` (M,), rays per cell n.
        out: (N, 5) mean luminance of the sky where it is open, and wherever; mean radiance of
            neighbours.
    """
    directions, weights, face, sunlit = rays
    rows, n = cells
    for m in range(len(rows)):
        seen, whole, red, green, blue = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            j = m * n + k
            w = weights[j]
            if w <= 0:
                continue
            light = w * sky_light.coarse_at(
                sky.coarse, directions[j, 0], directions[j, 1], directions[j, 2]
            )
            whole += light
            f = face[j]
            if f < 0:
                seen += light
                continue
            more = w if sunlit[j] else 0.0
            red += w * face_radiance[f, 0] + more * face_radiance[f, 3]
            green += w * face_radiance[f, 1] + more * face_radiance[f, 4]
            blue += w * face_radiance[f, 2] + more * face_radiance[f, 5]
        i = rows[m]
        out[i, 0], out[i, 1] = seen / n, whole / n
        out[i, 2], out[i, 3], out[i, 4] = red / n, green / n, blue / n


@njit(error_model="numpy")
def fill_tints(
    s: SurfaceArrays,
    tex: TextureArrays,
    hits: tuple[Int32, Int32, Array32],
    width: Array32,
    out: Array32,
) -> None:
    """Fill the base colours (N, 3) where rays arrive, in shares of their mesh's mean colour.

    Args:
        s: the surfaces.
        tex: their images.
        hits: placed mesh (N,), -1 = none, face (N,) and weights (N, 2) of its second and third
            corner.
        width: (N,) of the footprints [m].
        out: is filled; ones where there is no image and no vertex colour.
    """
    geometry, face, weights = hits
    for i in range(len(geometry)):
        g = geometry[i]
        for k in range(3):
            out[i, k] = 1.0
        if g < 0 or (s.images[g, 0] < 0 and s.first_color[g] < 0):
            continue
        b, w = weights[i, 0], weights[i, 1]
        red, green, blue = s.base[g, 0], s.base[g, 1], s.base[g, 2]
        if s.first_color[g] >= 0:
            r, gr, bl = weighted(s.colors, s.first_color[g] + face[i], (1.0 - b - w, b, w))
            red, green, blue = red * r, green * gr, blue * bl
        else:
            p, c = s.uv[s.first_face[g] + face[i]], s.corners[s.first_face[g] + face[i]]
            ux, uy = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1]
            vx, vy = p[2, 0] - p[0, 0], p[2, 1] - p[0, 1]
            length = 1e-18
            for k in range(3):
                length += (c[1, k] - c[0, k]) ** 2
            size = width[i] * np.sqrt((ux * ux + uy * uy) / length)
            at = (p[0, 0] + b * ux + w * vx, p[0, 1] + b * uy + w * vy)
            i0 = s.images[g, 0]
            r, gr, bl = color_at(tex, i0, at, footprint(tex, i0, (size, 0.0), (0.0, size), 1))
            red, green, blue = red * r, green * gr, blue * bl
        out[i, 0] = red / max(s.mean_color[g, 0], 1e-4)
        out[i, 1] = green / max(s.mean_color[g, 1], 1e-4)
        out[i, 2] = blue / max(s.mean_color[g, 2], 1e-4)
