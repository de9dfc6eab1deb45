"""What must not move: the look without an environment, and bytes under any number of threads."""

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.mesh import box_mesh
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.photo import Lighting, PhotoRenderer, PlacedMesh

LENS = np.array([-0.2, 0.06, 0.0004, -0.0007, 0.0])
VIEW = CameraIntrinsics(width=96, height=64, fx=80, fy=80, cx=47.3, cy=31.8, distortion=LENS)
T_WORLD_CAM = se3.look_at([0.35, -0.7, 0.6], [0, 0, 0.03])
GOLDEN_MEANS = np.array([
    [[77.4, 78.6, 82.3], [76.5, 77.3, 80.7], [75.6, 76.7, 80.4], [77.4, 78.7, 82.4]],
    [[93.0, 86.5, 81.2], [138.6, 119.0, 97.1], [124.4, 90.4, 73.7], [99.1, 90.8, 83.2]],
    [[159.9, 131.5, 99.9], [130.0, 100.3, 82.1], [159.9, 124.4, 92.8], [142.9, 119.4, 93.9]],
    [[82.6, 75.5, 69.3], [156.7, 128.7, 97.5], [170.4, 139.1, 104.1], [135.7, 114.5, 91.5]],
])  # fmt: skip
"""Mean colours of 4 x 4 blocks of the still life, 16 rows and 24 columns each [0, 255]."""
GOLDEN_STD, GOLDEN_STEP = 38.07, 2.873
"""Spread of all values, and mean difference of horizontal neighbours."""


def box(half: tuple[float, float, float], colors: bool = False) -> Mesh:
    paint = (np.arange(24).reshape(8, 3) * 10).astype(np.uint8) if colors else None
    return replace(box_mesh(-np.array(half), half), colors=paint)


def still_life() -> list[PlacedMesh]:
    """A wooden table with a painted, a coloured and a printed box."""
    print_ = np.zeros((8, 8, 3), np.uint8)
    print_[::2, ::2], print_[1::2, 1::2] = (220, 40, 30), (30, 60, 200)
    label = Material(base_color_image=print_, period_m=0.1, roughness=0.3)
    turned = se3.exp_so3([0, 0, 0.4])
    return [
        PlacedMesh(-1, box((0.5, 0.4, 0.02)), se3.from_translation([0, 0, -0.02])),
        PlacedMesh(0, box((0.06, 0.05, 0.08)), se3.from_rt(turned, [0.12, 0.05, 0.08])),
        PlacedMesh(1, box((0.05, 0.05, 0.05), True), se3.from_translation([-0.12, 0.1, 0.05])),
        PlacedMesh(2, box((0.07, 0.04, 0.03)), se3.from_translation([-0.05, -0.13, 0.03]), label),
    ]


def room() -> Environment:
    panorama = np.full((32, 64, 3), 0.2, np.float32)
    panorama[2:6, 10:20] = 15.0  # a lamp
    return Environment(panorama=panorama, sun=(0.5, 0.5, 0.4), sun_direction=(0.4, 0.3, 0.8))


@cache
def digests() -> list[str]:
    """Digests of the noisy picture in the even room and under an environment."""
    out = []
    for sky in (None, room()):
        renderer, rng = PhotoRenderer(still_life(), None, sky), np.random.default_rng(3)
        photo = renderer.render(VIEW, T_WORLD_CAM, rng)
        out.append(hashlib.sha256(photo.rgb.tobytes() + photo.depth_m.tobytes()).hexdigest())
    return out


def test_the_look_without_an_environment_stays() -> None:
    rgb = PhotoRenderer(still_life(), Lighting()).render(VIEW, T_WORLD_CAM).rgb.astype(float)
    assert np.abs(rgb.reshape(4, 16, 4, 24, 3).mean((1, 3)) - GOLDEN_MEANS).max() < 0.5
    assert rgb.std() == pytest.approx(GOLDEN_STD, abs=0.3)
    assert np.abs(np.diff(rgb, axis=1)).mean() == pytest.approx(GOLDEN_STEP, abs=0.1)


def test_where_nothing_stands_the_room_is_seen() -> None:
    photo = PhotoRenderer([]).render(VIEW, T_WORLD_CAM)
    assert np.all(photo.geometry == -1) and photo.rgb.min() > 30


@pytest.mark.slow
def test_the_bytes_do_not_depend_on_the_number_of_threads() -> None:
    threads = "3"
    limits = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "TBB_NUM_THREADS")
    script = (
        "import json, sys, cv2; sys.path.insert(0, sys.argv[1]);"
        "cv2.setNumThreads(int(sys.argv[2])); import test_photo_bytes as t;"
        "print(json.dumps(t.digests()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, os.path.dirname(__file__), threads],
        env={**os.environ, **dict.fromkeys(limits, threads)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert json.loads(done.stdout.splitlines()[-1]) == digests()
