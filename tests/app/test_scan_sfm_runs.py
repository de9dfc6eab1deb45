"""`realsim scan sfm` to the end with the real COLMAP: the robot's metre."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from begun_sessions import begun
from realsim.app.console import Console
from realsim.app.scan.sfm.run import SfmRequest, run_scan_sfm
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, View
from realsim.store import SessionStore

CAMERA = CameraIntrinsics(width=400, height=300, fx=330.0, fy=330.0, cx=199.5, cy=149.5)
VIEWS = 6
LEVELS_M = (0.0, 0.03)
"""Heights of the two printed squares; the upper one is smaller and lies in the middle."""
SIDES_M = (0.4, 0.14)


def print_of(seed: int, side_px: int) -> np.ndarray:
    """Return a square of random boxes of all sizes."""
    rng = np.random.default_rng(seed)
    image = np.full((side_px, side_px, 3), 200, np.uint8)
    for size in (100, 50, 25, 12):
        for _ in range(12 * (100 // size) ** 2):
            x, y = rng.integers(0, side_px, 2)
            w, h = rng.integers(size // 3 + 1, size + 1, 2)
            image[y : y + h, x : x + w] = rng.integers(10, 250, 3)
    return image


def photo(T_world_cam: np.ndarray) -> np.ndarray:
    """Return the picture of the two squares: each is seen through a homography."""
    import cv2

    K = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1.0]])
    T = se3.invert(T_world_cam)
    seen = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)
    for k, (z, side) in enumerate(zip(LEVELS_M, SIDES_M, strict=True)):
        texture = print_of(k, round(1500 * side))
        s = side / len(texture)
        plane = np.array([[s, 0, -side / 2], [0, s, -side / 2], [0, 0, z], [0, 0, 1]])
        H = K @ (T[:3] @ plane)
        size = (CAMERA.width, CAMERA.height)
        warped = cv2.warpPerspective(texture, H, size, flags=cv2.INTER_AREA)
        cover = cv2.warpPerspective(np.full(texture.shape[:2], 255, np.uint8), H, size)
        seen[cover > 127] = warped[cover > 127]
    return seen


def cameras(count: int = VIEWS) -> np.ndarray:
    """Return cameras (V, 4, 4) on an arc over the squares."""
    turn = np.linspace(0.0, 1.2, count)
    eyes = np.stack([0.2 * np.cos(turn), 0.2 * np.sin(turn), 0.30 + 0.04 * np.sin(5 * turn)], -1)
    return np.stack([se3.look_at(eye, np.zeros(3)) for eye in eyes])


def session(folder: Path, Ts: np.ndarray) -> SessionStore:
    store = begun(folder, CAMERA, {"plan_hash": "p" * 64})
    for k, T in enumerate(Ts):
        view = View(index=k, T_base_ee=T, joints=np.zeros(6), time_s=float(k))
        store.add_view(view, photo(T))
    store.set_cameras(CAMERA, dict(enumerate(Ts)))
    return store


def report(folder: Path, **options: object) -> dict[str, Any]:
    """Run the command; return its report."""
    run_scan_sfm(SfmRequest(images=folder, **options), Console(quiet=True))  # pyright: ignore[reportArgumentType]
    return json.loads((folder / "scans/sfm/sfm.json").read_text())


def read_cameras(folder: Path) -> np.ndarray:
    """T_world_cam (V, 4, 4) of the views that were found."""
    views = json.loads((folder / "scans/sfm/cameras.json").read_text())["views"]
    return np.array([v["T_world_cam"] for v in views])


@pytest.mark.slow
def test_free_mapping_has_the_robots_metre(tmp_path: Path) -> None:
    Ts = cameras()
    session(tmp_path / "s", Ts)
    told = report(tmp_path / "s", poses="unknown")
    found = read_cameras(tmp_path / "s")
    assert len(found) == VIEWS and told["verdict"] == "accepted", told["reasons"]
    apart = np.linalg.norm(found[:, :3, 3] - Ts[:, :3, 3], axis=1)
    assert 1e3 * apart.max() < 2.0
    size = np.linalg.norm(found[0, :3, 3] - found[-1, :3, 3])
    true = np.linalg.norm(Ts[0, :3, 3] - Ts[-1, :3, 3])
    assert size / true == pytest.approx(1.0, abs=0.01)


@pytest.mark.slow
def test_refinement_mends_poses_that_are_wrong(tmp_path: Path) -> None:
    Ts = cameras(8)
    s = np.repeat([np.radians(0.3), 2e-3], 3)
    robot = Ts @ se3.exp(s * np.random.default_rng(1).standard_normal((len(Ts), 6)))

    def between(found: np.ndarray) -> float:
        """Return the error of the poses relative to the first one [mm], median."""
        a, b = (se3.invert(T[:1]) @ T[1:] for T in (found, Ts))
        return 1e3 * float(np.median(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)))

    session(tmp_path / "wrong", Ts).set_cameras(CAMERA, dict(enumerate(robot)))
    report(tmp_path / "wrong", poses="refined")
    found = read_cameras(tmp_path / "wrong")
    assert between(found) <= max(0.5 * between(robot), 0.3)
