"""Maps of the surfaces that a view sees: where on its object a pixel lies, and how it is turned."""

import numpy as np

from realsim.arrays import Array, Array32, Int32, Int64, Mask
from realsim.compiled import njit
from realsim.geometry.point_loops import move, turn_back


@njit
def surface_maps(
    rays: Array32,
    hits: tuple[Array32, Int32, Int32],
    Ts_obj_cam: Array,
    normals: Array32,
    starts: Int64,
    labelled: Mask,
    wanted: int,
) -> Array32:
    """Return a map (H, W, 3) of the surfaces seen: 0 = object coordinates, 1 = camera normals.

    Args:
        rays: (H, W, 3).
        hits: depth (H, W), 0 = nothing [m]; placed mesh (H, W), -1 = nothing; its face (H, W).
        Ts_obj_cam: (G, 4, 4).
        normals: (F, 3) unit normals of all meshes' faces, in the meshes' frames.
        starts: (G,) number of a mesh's first face among them.
        labelled: (G,) whether the map is wanted on this mesh.
        wanted: which map.
    """
    depth, geometry, face = hits
    height, width = depth.shape
    out = np.zeros((height, width, 3), np.float32)
    for v in range(height):
        for u in range(width):
            g = geometry[v, u]
            if g < 0 or not labelled[g]:
                continue
            T = Ts_obj_cam[g]
            if wanted == 0:
                z = np.float64(depth[v, u])
                x, y = z * rays[v, u, 0], z * rays[v, u, 1]
                out[v, u, 0], out[v, u, 1], out[v, u, 2] = move(T, x, y, z)
            else:
                n = normals[starts[g] + face[v, u]]
                # R_cam_obj is the transpose of R_obj_cam.
                x, y, z = turn_back(T, n[0], n[1], n[2])
                away = x * rays[v, u, 0] + y * rays[v, u, 1] + z > 0.0
                side = -1.0 if away else 1.0
                out[v, u, 0], out[v, u, 1], out[v, u, 2] = side * x, side * y, side * z
    return out
