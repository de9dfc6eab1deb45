"""What a complete label set costs, against one plain Open3D cast of every pixel.

Imported by `labels.py`. Both are measured frame by frame in turn, so that a busy machine slows
both. The plain cast is `RaycastingScene.cast_rays` alone: rays built before, nothing read back but
the ids.
"""

import resource
import sys
import time

import numpy as np
from figures import Found
from labels_scene import camera_720p, camera_1080p, cameras, faces_of, scene

from realsim.geometry import camera
from realsim.records import CameraIntrinsics
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.rays import RayScene, rotated

Timings = dict[str, list[float]]
AS_FILES = ("labels", "coordinates", "normals")


def label_cost(seed: int, quick: bool) -> Found:
    """Return the CPU of a complete label set over that of one cast of every pixel."""
    found = Found()
    placed = scene()
    found.over["scene"] = f"15 meshes, {faces_of(placed)} faces, table"
    sets = {
        "720p": (camera_720p(), cameras(4 if quick else 256, 0.5, 0.7)),
        "1080p": (camera_1080p(), cameras(3 if quick else 256, 1.0, 2.0)),
    }
    for name, (intrinsics, views) in sets.items():
        timings = _measured(placed, intrinsics, views)
        total = {k: float(np.sum(v)) for k, v in timings.items()}
        whole = sum(total[k] for k in AS_FILES)
        found.figures[f"labels_over_cast_{name}"] = whole / total["cast"]
        found.figures[f"labels_cpu_ms_{name}"] = 1e3 * whole / len(views)
        found.rivals[f"labels_over_cast_{name}"] = (
            f"one cast {1e3 * total['cast'] / len(views):.0f} ms a frame"
        )
        parts = ", ".join(f"{k} {1e3 * v / len(views):.1f}" for k, v in total.items())
        found.over[f"labels_{name}"] = f"{len(views)} views; CPU ms a frame: {parts}"
    distorted = camera_720p(distorted=True)
    timings = _measured(placed, distorted, cameras(3 if quick else 64, 0.5, 0.7))
    found.figures["labels_over_cast_distorted"] = sum(
        float(np.sum(timings[k])) for k in AS_FILES
    ) / float(np.sum(timings["cast"]))
    # On Linux ru_maxrss is in KiB.
    scale = 1 if sys.platform == "darwin" else 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale
    found.figures["labels_peak_mb"] = peak / 1e6
    found.over["labels_peak_mb"] = "of the process, the rival's scene and rays included"
    return found


def _measured(placed, intrinsics: CameraIntrinsics, views) -> Timings:
    renderer, rival = LabelRenderer(placed), RayScene(placed)
    table = camera.ray_table(intrinsics)
    timings: Timings = {k: [] for k in (*AS_FILES, "cast")}

    def timed(name: str, work):
        start = time.process_time()
        result = work()
        timings[name].append(time.process_time() - start)
        return result

    # Compiles, commits, fills caches.
    warm = renderer.render(intrinsics, views[0])
    warm.object_coordinates(), warm.normals()
    _cast(rival, _rays(rival, table, views[0]))
    for T in views:
        labels = timed("labels", lambda T=T: renderer.render(intrinsics, T))
        timed("coordinates", labels.object_coordinates)
        timed("normals", labels.normals)
        rays = _rays(rival, table, T)
        timed("cast", lambda rays=rays: _cast(rival, rays))
    return timings


def _rays(rival: RayScene, table, T):
    directions = rotated(table, T[:3, :3]).reshape(-1, 3)
    directions = np.nan_to_num(directions, nan=0.0)
    return rival._rays(T[:3, 3], directions)


def _cast(rival: RayScene, rays):
    return rival._scene.cast_rays(rays)["geometry_ids"].numpy()
