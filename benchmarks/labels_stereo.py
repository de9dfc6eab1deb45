"""What the stereo simulator costs, against the complete label set of the same view.

`stereo_cost` is the part of the label benchmark. Both are measured frame by frame in turn, so that
a busy machine slows both. Stereo: light of both eyes, their pictures, the match, depth. Labels:
render, object coordinates and normals.
"""

import time

import numpy as np
from figures import Found
from labels_scene import camera_720p, cameras, faces_of, scene

from realsim.rendering.depth_sensors.profiles import profile
from realsim.rendering.labels import LabelRenderer
from realsim.rendering.stereo import StereoCamera

NAMES = ("d405", "d435")


def stereo_cost(seed: int, quick: bool) -> Found:
    """Return the CPU of a simulated stereo depth over that of its labels, the worst camera's."""
    found = Found()
    placed, intrinsics = scene(), camera_720p()
    views = cameras(3 if quick else 48, 0.5, 0.7)
    renderer = LabelRenderer(placed)
    ratios: dict[str, float] = {}
    for name in NAMES:
        sensor = StereoCamera(placed, profile(name))
        stereo_s, labels_s, filled = _measured(sensor, renderer, intrinsics, views, seed)
        ratios[name] = stereo_s / labels_s
        found.notes.append(
            f"stereo {name}: {1e3 * stereo_s:.0f} ms a frame of CPU, its labels "
            f"{1e3 * labels_s:.0f} ms, {stereo_s / labels_s:.2f} x; {100 * filled:.1f} % of what "
            "is in view has depth"
        )
    worst = max(ratios, key=lambda n: ratios[n])
    found.figures["stereo_over_labels"] = ratios[worst]
    said = ", ".join(f"{n} {r:.2f}" for n, r in ratios.items())
    found.over["stereo_over_labels"] = (
        f"{len(views)} views at 1280x720, {faces_of(placed)} faces; the worst of {said}"
    )
    return found


def _measured(sensor, renderer, intrinsics, views, seed: int) -> tuple[float, float, float]:
    """Return mean CPU of stereo and labels [s], and the share of surfaces with depth."""
    rng = np.random.default_rng(seed)
    stereo, labels, filled = [], [], []
    # The first view compiles and fills caches.
    for k, T in enumerate([views[0], *views]):
        start = time.process_time()
        exact = renderer.render(intrinsics, T)
        exact.object_coordinates(), exact.normals()
        between = time.process_time()
        depth = sensor.measure(intrinsics, T, rng).depth_m
        if k > 0:
            labels.append(between - start)
            stereo.append(time.process_time() - between)
            filled.append(float(np.mean(depth[exact.depth_m > 0] > 0)))
    return float(np.mean(stereo)), float(np.mean(labels)), float(np.mean(filled))
