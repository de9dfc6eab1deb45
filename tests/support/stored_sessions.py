"""A small stored session that tests damage: six views, a plan, camera poses, board views inside."""

from pathlib import Path

import numpy as np

from begun_sessions import begun
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, View
from realsim.store import SessionStore

CAMERA = CameraIntrinsics(
    width=40, height=30, fx=38.1, fy=38.2, cx=19.7, cy=14.9, distortion=np.array([0.05, 0.01])
)
VIEWS = 6


def images_of(index: int, take: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng([index, take])
    rgb = rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    return rgb, rng.integers(3000, 4000, (30, 40)).astype(np.uint16)


def view_of(index: int) -> View:
    rng = np.random.default_rng(index)
    return View(
        index=index, T_base_ee=se3.random_transform(rng), joints=rng.normal(size=6),
        time_s=100.0 + index,
    )  # fmt: skip


def add(store: SessionStore, index: int, take: int = 0) -> None:
    rgb, counts = images_of(index, take)
    store.add_view(view_of(index), rgb, depth_counts=counts)


def make_whole(folder: Path) -> None:
    store = begun(folder, CAMERA, {"plan_hash": "p" * 64, "camera": "D405 17"}, name="whole")
    store.write_json("plan.json", {"sha256": "p" * 64, "content": {"joints": [[0] * 6] * 8}})
    for index in range(VIEWS):
        add(store, index)
    Ts = se3.random_transform(np.random.default_rng(5), VIEWS)
    store.set_cameras(CAMERA, {k: Ts[k] for k in range(VIEWS)})
    store.write_json("calibration/hand_eye.json", {"a": list(range(50))})
    inner = begun(folder / "calibration/capture", CAMERA, {"plan_hash": "q"})
    for index in range(3):
        add(inner, index)


def flip(path: Path, place: int) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 0x10
    path.write_bytes(bytes(data))
