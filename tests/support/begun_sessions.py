"""Sessions that a test begins: a header without views, and views as a renderer draws them."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, UInt8
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, CaptureSession, View
from realsim.rendering.labels import LabelRenderer
from realsim.store import SessionStore


def begun(
    folder: Path, camera: CameraIntrinsics, extra: dict[str, Any] | None = None, *,
    name: str = "test", unit_m: float = 1e-4,
) -> SessionStore:  # fmt: skip
    """Return a new session that has no views yet."""
    session = CaptureSession(name=name, intrinsics=camera, depth_unit_m=unit_m)
    return SessionStore.create(folder, session, extra)


def random_views(store: SessionStore, indices: Iterable[int]) -> None:
    """Add views of noise whose cameras look at the world's origin."""
    camera = store.session.intrinsics
    rng = np.random.default_rng(0)
    for index in indices:
        T = se3.look_at(rng.uniform(0.3, 0.5, 3), [0, 0, 0])
        rgb = rng.integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8)
        store.add_view(View(index=index, T_world_cam=T), rgb, rng.uniform(0.2, 1, rgb.shape[:2]))


def light_things(ids: Array) -> UInt8:
    """Return a photograph of light things before dark."""
    return np.where((ids >= 0)[..., None], 200, 90).astype(np.uint8).repeat(3, -1)


def add_drawn(
    store: SessionStore, renderer: LabelRenderer, Ts_world_cam: Iterable[Array],
    photograph: Callable[[Array], UInt8] = light_things,
) -> SessionStore:  # fmt: skip
    """Add exact depth from these poses, and what `photograph` makes of whose pixel is whose."""
    for index, T in enumerate(Ts_world_cam):
        labels = renderer.render(store.session.intrinsics, T)
        store.add_view(View(index=index, T_world_cam=T), photograph(labels.ids), labels.depth_m)
    return store
