"""Pictures of a registration: their geometry by laws, and that all of them are drawn."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from realsim.app.register.gain import camera_shifts_px, gain_picture, zoomed_camera
from realsim.app.register.map import place_covariance_mm2
from realsim.app.register.page import page_bytes
from realsim.app.register.pictures import draw_pictures
from realsim.app.register.results import CameraChange, Registered
from realsim.app.register.run import pixel_sigma
from realsim.geometry import camera, se3
from realsim.geometry.parts import part
from realsim.records import CameraIntrinsics, ObjectPose
from realsim.store import SessionStore
from registered_sessions import CAMERA, models_of, registered_by_hand

MODELS = models_of()


@pytest.fixture(scope="module")
def store(few_views: Path) -> SessionStore:
    return SessionStore.open(few_views)


@pytest.fixture(scope="module")
def result(store: SessionStore) -> Registered:
    """Its registration."""
    return registered_by_hand(store)


def size_of(data: bytes) -> tuple[int, int]:
    """Return width and height of a picture that can be read."""
    with Image.open(io.BytesIO(data)) as picture:
        picture.load()
        return picture.size


def test_every_picture_is_drawn_and_stands_on_the_page(
    store: SessionStore, result: Registered
) -> None:
    pictures = draw_pictures(store, result, MODELS)
    assert set(pictures) == {"overlay.jpg", "cameras.jpg", "residuals.jpg", "map.png"}
    assert all(min(size_of(data)) > 400 for data in pictures.values())
    page = page_bytes(store, result, MODELS, pictures).decode()
    assert page.count("data:image/jpeg;base64,") == 3 and page.count("data:image/png") == 1
    assert "half of it is hidden." in page and "nothing there looks like it." in page
    assert (
        "cameras moved by 0.47 mm / 0.11 deg together (hand-eye), 0.19 mm / 0.03 deg each" in page
    )
    assert "http" not in page.replace("http-equiv", "")  # nothing is loaded from elsewhere


def test_what_cannot_be_drawn_is_left_out(store: SessionStore, result: Registered) -> None:
    claimed = result.cameras.claimed
    still = replace(result, cameras=CameraChange(claimed=claimed, refined=dict(claimed)))
    assert "cameras.jpg" not in draw_pictures(store, still, MODELS)
    nothing = replace(result, scene=replace(result.scene, objects=()), seen={})
    assert draw_pictures(store, nothing, MODELS) == {}
    assert b"Not placed" in page_bytes(store, nothing, MODELS, {})


def test_the_gain_is_shown_on_the_object_that_moved_most(
    store: SessionStore, result: Registered
) -> None:
    refined = result.cameras.refined
    claimed = {k: T.copy() for k, T in refined.items()}
    assert set(camera_shifts_px(_with(result, claimed), MODELS, CAMERA).values()) == {0.0}
    claimed[2] = refined[2] @ se3.exp(np.array([0.0, 0.01, 0.0, 0.0, 0.0, 0.0]))
    shifts = camera_shifts_px(_with(result, claimed), MODELS, CAMERA)
    assert {k for (k, _), px in shifts.items() if px > 1e-9} == {2}
    # A turn of 10 mrad about y moves what is near the middle by 3 px at f = 300.
    assert all(px == pytest.approx(3.0, rel=0.12) for (k, _), px in shifts.items() if k == 2)
    assert gain_picture(store, _with(result, claimed), MODELS) is not None


def _with(result: Registered, claimed: dict[int, np.ndarray]) -> Registered:
    """Return a registration with other claims."""
    return replace(result, cameras=CameraChange(claimed=claimed, refined=result.cameras.refined))


def test_a_zoomed_camera_sees_the_same_points_enlarged() -> None:
    lens = np.array([-0.05, 0.06, 3e-4, -2e-4, 0.0])
    raw = CameraIntrinsics(
        width=1280, height=720, fx=645.0, fy=643.0, cx=640.3, cy=358.7, distortion=lens
    )
    points = np.random.default_rng(0).uniform([-0.2, -0.1, 0.4], [0.2, 0.1, 0.6], (50, 3))
    uv = camera.project(raw, points)
    zoomed = zoomed_camera(raw, (300, 200), 64, 10)
    # A pixel's area, from its centre -1/2 to +1/2, becomes ten pixels.
    expected = (uv - [300, 200] + 0.5) * 10 - 0.5
    np.testing.assert_allclose(camera.project(zoomed, points), expected, atol=1e-9)
    assert (zoomed.width, zoomed.height) == (640, 640)


def test_pixel_sigma_is_what_random_poses_show() -> None:
    rng = np.random.default_rng(4)
    T_cam_obj = se3.exp(np.array([0.4, -0.2, 0.9, 0.02, -0.03, 0.45]))
    A = rng.normal(size=(6, 6)) * np.repeat([2e-3, 3e-4], 3)[:, None]
    points = part("mug").mesh.vertices[::50]
    there = camera.project(CAMERA, se3.transform(T_cam_obj, points))
    seen = [
        camera.project(CAMERA, se3.transform(T_cam_obj @ se3.exp(A @ rng.normal(size=6)), points))
        for _ in range(2000)
    ]
    spread = np.sqrt(np.mean(np.sum((np.array(seen) - there) ** 2, axis=-1)))
    assert pixel_sigma(CAMERA, T_cam_obj, A @ A.T, points) == pytest.approx(spread, rel=0.06)
    assert np.isnan(pixel_sigma(CAMERA, T_cam_obj, np.full((6, 6), np.nan), points))


def test_the_ellipse_is_where_random_poses_put_the_middle() -> None:
    rng = np.random.default_rng(5)
    model = part("mug")
    A = rng.normal(size=(6, 6)) * np.repeat([3e-3, 5e-4], 3)[:, None]
    T, T_map_world = se3.exp(rng.normal(size=6) * 0.5), se3.exp(rng.normal(size=6) * 0.5)
    pose = ObjectPose(obj_id=model.obj_id, instance=0, T_world_obj=T, covariance=A @ A.T)
    middle = model.mesh.bounds.mean(0)[None]
    places = [
        1e3 * se3.transform(T_map_world @ T @ se3.exp(A @ rng.normal(size=6)), middle)[0, :2]
        for _ in range(4000)
    ]
    C = place_covariance_mm2(pose, model, T_map_world)
    assert C is not None
    np.testing.assert_allclose(C, np.cov(np.array(places).T), atol=0.08 * np.trace(C))
