"""Where a flat object lies on the table, from the step at its outline.

Of a plate of 2 mm hardly a point lies on its sides, and those that do are half the table's. What
shows where it lies is the height of all points around it: the object's inside its outline, zero
outside. With m(x) the height of the object over the table, seen from above, a point whose ray
crosses at x and whose height is h has the residual
    r = h - m(x),    dr = (m_x, m_y, m_x (c_y - y) + m_y (x - c_x)) . (t_x, t_y, turn about c)
for a move of the object on the table. m is blurred, less in every round: its slope is how far off
a start may be. A ray is placed by where it crosses half the object's height, not by its measured
point, whose noise would move it sideways too.
"""

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.models.resting import resting_orientations
from realsim.registration.body import Body

CELL_M = 5e-4
"""Cells of the map of heights [m]."""
MARGIN_M = 0.012
"""How far the map reaches beyond the object [m]."""
OUTLINE_M = 0.0004
"""1-sigma of where the sensor shows an outline [m]."""
LOW, STEEP = 0.5, 0.9
"""Rays less steep are not used, steeper ones fully: low ones see far edges only, and too wide."""
LEAN_DEG = 5.0
"""A flat object that leans by more does not lie on the table [deg]."""
CUT_SIGMAS = 4.0
"""Points whose height is further off than this and than the object is high are something else."""


def is_flat(body: Body, T_table_obj: Array, most_m: float) -> bool:
    """Return whether the object rises less than `most_m` over the table on which it lies."""
    z = body.model.mesh.vertices @ T_table_obj[2, :3] + T_table_obj[2, 3]
    return bool(np.ptp(z) < most_m and abs(float(z.min())) < most_m)


def laid_down(body: Body, Ts_table_obj: Array, most_m: float) -> Array:
    """Return poses (N, 4, 4) of a flat object laid down on the table where they nearly lie on it.

    One view tells a plate's tilt worse than the table does. Poses that lean by more than
    `LEAN_DEG`, or lie higher or lower than `most_m`, stay: something else carries them.
    """
    if min(body.model.mesh.extent) > most_m:
        return Ts_table_obj
    up = np.array([r.R[2] for r in resting_orientations(body.model.mesh) if r.height < most_m])
    if len(up) == 0:
        return Ts_table_obj
    out = Ts_table_obj.copy()
    for T in out:
        best = up[int(np.argmax(up @ T[2, :3]))]
        away = T[:3, :3] @ best
        across = np.array([away[1], -away[0], 0.0])  # away x up
        sine = float(np.linalg.norm(across))
        low = float((body.model.mesh.vertices @ T[2, :3]).min() + T[2, 3])
        if best @ T[2, :3] < np.cos(np.radians(LEAN_DEG)) or abs(low) > most_m:
            continue
        c = T[:3, :3] @ body.center_obj + T[:3, 3]
        turn = se3.exp_so3(across * (np.arctan2(sine, away[2]) / max(sine, 1e-12)))
        T[:3, 3] = c + turn @ (T[:3, 3] - c)
        T[:3, :3] = turn @ T[:3, :3]
        T[2, 3] -= float((body.model.mesh.vertices @ T[2, :3]).min() + T[2, 3])
    return out


def step_term(
    body: Body, T_table_obj: Array, points: Array, eyes: Array, sigmas: Array, blur_m: float
) -> tuple[Array, Array]:
    """Return the normal matrix (6, 6) and right side (6,) of the object's twist about its centre.

    Args:
        body: the object.
        T_table_obj: (4, 4) its pose on the table, z up.
        points: (N, 3) measured around it, in the table's frame [m].
        eyes: (N, 3) the cameras' places there.
        sigmas: (N,) of the points along their rays; crowding included [m].
        blur_m: by which the map is blurred [m].
    """
    from scipy.ndimage import gaussian_filter, map_coordinates

    heights, low = height_map(body, T_table_obj, CELL_M)
    top = float(heights.max())
    m = gaussian_filter(heights, blur_m / CELL_M)
    rays = points - eyes
    along = (0.5 * top - eyes[:, 2]) / np.minimum(rays[:, 2], -1e-6)
    at = (eyes[:, :2] + along[:, None] * rays[:, :2]).T
    cells = (at - low[:, None]) / CELL_M

    def there(image: Array) -> Array:
        return np.asarray(map_coordinates(image, cells, order=1, mode="nearest"))

    slopes = np.stack([there(np.asarray(s)) / CELL_M for s in np.gradient(m)])
    r = points[:, 2] - there(m)
    sigma = sigmas * np.abs(rays[:, 2]) / np.linalg.norm(rays, axis=1)
    w = np.square(np.clip(1.0 - np.square(r / (CUT_SIGMAS * sigma + top)), 0.0, None)) / sigma**2
    inside = np.all((cells > 0) & (cells < np.array(m.shape)[:, None] - 1), axis=0)
    down = np.abs(rays[:, 2]) / np.linalg.norm(rays, axis=1)
    w = np.where(inside, w * np.clip((down - LOW) / (STEEP - LOW), 0.0, 1.0), 0.0)
    centre = T_table_obj[:3, :3] @ body.center_obj + T_table_obj[:3, 3]
    x, y = at - centre[:2, None]
    J = np.stack([*slopes, slopes[1] * x - slopes[0] * y])
    R = T_table_obj[:3, :3]
    moved = np.zeros((3, 6))
    moved[:2, 3:], moved[2, :3] = R[:2], R[2]
    H, b = (J * w) @ J.T, -J @ (w * r)
    # The outline's own error is common to all points: as precise as that, and no more.
    S = np.diag([OUTLINE_M, OUTLINE_M, OUTLINE_M / body.radius_m]) ** 2
    share = np.linalg.inv(np.eye(3) + H @ S)
    H, b = share @ H, share @ b
    return moved.T @ H @ moved, moved.T @ b


def height_map(body: Body, T_table_obj: Array, cell_m: float) -> tuple[Array, Array]:
    """Return the object's height (X, Y) over the table seen from above, and the first cell (2,)."""
    from realsim.interop import import_open3d

    o3d = import_open3d()
    vertices = se3.transform(T_table_obj, body.model.mesh.vertices)
    low = vertices.min(axis=0) - MARGIN_M
    top = float(vertices[:, 2].max()) + MARGIN_M
    shape = np.ceil((vertices.max(axis=0)[:2] + MARGIN_M - low[:2]) / cell_m).astype(int) + 1
    grid = np.moveaxis(np.indices(tuple(shape)), 0, -1) * cell_m + low[:2]
    start = np.concatenate([grid, np.full((*shape, 1), top)], axis=-1)
    T = se3.invert(T_table_obj)
    rays = np.empty((*shape, 6), np.float32)
    rays[..., :3], rays[..., 3:] = (
        se3.transform(T, start.reshape(-1, 3)).reshape(start.shape),
        -T[:3, 2],
    )
    depth = body.ray_scene.cast_rays(o3d.core.Tensor(rays), 1)["t_hit"].numpy()
    return np.where(np.isfinite(depth), np.maximum(top - depth, 0.0), 0.0), low[:2]
