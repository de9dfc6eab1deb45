"""Standing in a camera: outlines lie on the straightened photograph, whatever the lens."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from realsim.arrays import Array, Mask, UInt8
from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, CaptureSession, ObjectPose, View
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.rendering.overlay import VERDICT_RGB
from realsim.review.placing.camera_view import CameraViews, pinhole_of, straightened
from realsim.store import SessionStore
from tests.support.synthetic_scenes import MODELS, TABLE, placed

LENS = CameraIntrinsics(
    width=640, height=480, fx=430.0, fy=436.0, cx=309.0, cy=251.0,
    distortion=np.array([-0.32, 0.12, 0.002, -0.003, -0.02]),
)  # fmt: skip
TALL, FLAT = placed(1, 0, -0.05, 0.02), placed(7, 3, 0.09, -0.04, verdict="doubtful")
T_CAM = TABLE @ se3.look_at([0.03, -0.30, 0.25], [0.02, 0.0, 0.04])


def session_of(folder: Path, T_world_cam: Array | None = T_CAM) -> SessionStore:
    """Return a session with one photograph: objects white, the rest dark."""
    session = CaptureSession(name="lens", intrinsics=LENS, views=(), depth_unit_m=1e-4)
    store = SessionStore.create(folder, session)
    meshes = [PlacedMesh(o.instance, MODELS[o.obj_id].mesh, o.T_world_obj) for o in (TALL, FLAT)]
    labels = LabelRenderer(meshes).render(LENS, T_CAM)
    rgb = np.where((labels.ids >= 0)[..., None], 255, 20).astype(np.uint8).repeat(3, -1)
    store.add_view(View(index=4, T_world_cam=T_world_cam), rgb)
    return store


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SessionStore:
    return session_of(tmp_path_factory.mktemp("view") / "s")


@pytest.fixture(scope="module")
def views(store: SessionStore) -> CameraViews:
    return CameraViews(store, MODELS)


def on_the_canvas(pinhole: CameraIntrinsics, o: ObjectPose, T_world_cam: Array = T_CAM) -> Array:
    """Return the pixels (V, 2) of an object's vertices: through the lens, and straightened."""
    p = se3.transform(se3.invert(T_world_cam) @ o.T_world_obj, MODELS[o.obj_id].mesh.vertices)
    xy, known = camera.undistort(LENS, camera.project(LENS, p))
    assert known.all()
    return xy * [pinhole.fx, pinhole.fy] + [pinhole.cx, pinhole.cy]


def silhouette(corners: Array) -> Array:
    """Return points (N, 2) along the convex outline of a box's corners."""
    from scipy.spatial import ConvexHull

    hull = corners[ConvexHull(corners).vertices]
    t = np.linspace(0, 1, 400)[:, None]
    return np.concatenate(
        [a + t * (b - a) for a, b in zip(hull, np.roll(hull, -1, 0), strict=True)]
    )


def farthest(points: Array, among: Array) -> float:
    """Return the greatest distance of a point (N, 2) from the nearest of others (M, 2) [px]."""
    from scipy.spatial import KDTree

    return float(KDTree(among).query(points)[0].max())


def drawn_in(rgb: UInt8, verdict: str) -> Mask:
    """Return the pixels (H, W) of a verdict's colour, softened edges left out."""
    return np.all(np.abs(rgb.astype(int) - VERDICT_RGB[verdict]) < 30, axis=-1)


@pytest.mark.parametrize("aspect", [0.7, 2.4])
def test_outlines_lie_where_the_lens_and_its_straightening_put_them(
    views: CameraViews, aspect: float
) -> None:
    pinhole = pinhole_of(LENS, aspect, 960)
    for o in (TALL, FLAT):
        rgb = views.picture(4, [o], aspect=aspect).rgb
        line = silhouette(on_the_canvas(pinhole, o))
        drawn = drawn_in(rgb, o.verdict)
        pixels = np.argwhere(drawn)[:, ::-1].astype(float)
        assert farthest(line, pixels) < 1.0
        # And nothing is drawn elsewhere: the line is 2 px wide.
        assert farthest(pixels, line) < 2.5


def test_straightening_is_exact_for_a_smooth_picture() -> None:
    """A picture whose brightness is the ray's own slope reads the same through any camera."""
    pinhole = pinhole_of(LENS, 4 / 3, 640)
    rays = camera.ray_table(LENS)
    ramp = np.rint(128 + 80 * rays[..., :2]).clip(0, 255).astype(np.uint8)
    rgb = np.concatenate([ramp, np.zeros_like(ramp[..., :1])], -1)
    out = straightened(rgb, LENS, pinhole).astype(float)
    xy = camera.ray_table(pinhole)[..., :2]
    middle = np.linalg.norm(xy, axis=-1) < 0.5
    assert np.abs(out[..., :2] - (128 + 80 * xy))[middle].max() < 1.0


@pytest.mark.parametrize("aspect", [0.5, 3.0])
def test_the_whole_photograph_is_on_the_canvas_and_touches_its_border(aspect: float) -> None:
    pinhole = pinhole_of(LENS, aspect, 800)
    assert pinhole.width / pinhole.height == pytest.approx(aspect, rel=2e-3)
    border = camera.pixel_grid(LENS.width, LENS.height)
    border = np.concatenate([border[[0, -1]].reshape(-1, 2), border[:, [0, -1]].reshape(-1, 2)])
    xy, known = camera.undistort(LENS, border)
    uv = xy[known] * pinhole.fx + [pinhole.cx, pinhole.cy]
    inside = (uv > -0.6) & (uv < np.array([pinhole.width, pinhole.height]) - 0.4)
    assert inside.all()
    room = np.minimum(uv.min(0), [pinhole.width - 1, pinhole.height - 1] - uv.max(0)).min()
    assert room < 3.0


def test_the_field_of_view_is_that_of_a_browser_s_camera(views: CameraViews) -> None:
    """A point on the upper border of the canvas is half the field of view off the axis."""
    picture = views.picture(4, [TALL], aspect=1.5, width_px=600)
    height, width = picture.rgb.shape[:2]
    assert (width, height, picture.aspect) == (600, 400, 1.5)
    focal = 0.5 * height / np.tan(0.5 * picture.fov_rad)
    pinhole = pinhole_of(LENS, 1.5, 600)
    assert focal == pytest.approx(pinhole.fx) == pytest.approx(pinhole.fy)
    assert (pinhole.cx + 0.5, pinhole.cy + 0.5) == (width / 2, height / 2)
    np.testing.assert_array_equal(picture.T_world_cam, T_CAM)


def test_what_another_object_hides_is_dashed_and_the_highlighted_one_is_bold(
    views: CameraViews,
) -> None:
    eye = se3.invert(T_CAM) @ TALL.T_world_obj
    behind = replace(
        FLAT, verdict="rejected",
        T_world_obj=T_CAM @ se3.from_rt(eye[:3, :3], 1.25 * eye[:3, 3]),
    )  # fmt: skip
    alone = drawn_in(views.picture(4, [behind], aspect=1.5).rgb, "rejected").sum()
    hidden = drawn_in(views.picture(4, [behind, TALL], aspect=1.5).rgb, "rejected").sum()
    assert 0.2 * alone < hidden < 0.8 * alone
    bold = drawn_in(views.picture(4, [behind], aspect=1.5, highlight=3).rgb, "rejected").sum()
    assert bold > 1.4 * alone


def test_an_object_behind_the_camera_or_without_a_model_is_not_drawn(views: CameraViews) -> None:
    bare = views.picture(4, [], aspect=1.5).rgb
    away = replace(TALL, T_world_obj=T_CAM @ se3.from_translation([0, 0, -1.0]))
    unknown = replace(TALL, obj_id=99)
    np.testing.assert_array_equal(views.picture(4, [away, unknown], aspect=1.5).rgb, bare)


def test_bad_input_is_refused(views: CameraViews, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="view"):
        views.picture(77, [], aspect=1.5)
    with pytest.raises(InputError, match="wide"):
        views.picture(4, [], aspect=float("nan"))
    with pytest.raises(InputError, match="px"):
        views.picture(4, [], aspect=1.0, width_px=0)
    lost = session_of(tmp_path / "lost", None)
    with pytest.raises(InputError, match="not known"):
        CameraViews(lost, MODELS).picture(4, [], aspect=1.5)
