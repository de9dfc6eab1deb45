"""Labels: exact rays, amodal masks, counts beyond the border, and occlusion."""

import numpy as np
import pytest

from plain_meshes import ball, box
from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from refusals import refused

LENS = np.array([-0.08, 0.06, 0.0008, -0.0011, -0.02])
CAMERA = CameraIntrinsics(width=320, height=180, fx=163.0, fy=161.0, cx=158.7, cy=91.2,
                          distortion=LENS)  # fmt: skip


def table() -> PlacedMesh:
    return PlacedMesh(-1, box((1.2, 1.0, 0.02)), se3.from_translation([0.4, 0, -0.01]))


def clutter(seed: int = 0, n: int = 6) -> list[PlacedMesh]:
    rng = np.random.default_rng(seed)
    placed = [table()]
    for i in range(n):
        R = se3.exp_so3([0, 0, rng.uniform(0, 6)])
        T = se3.from_rt(R, [0.4 + rng.uniform(-0.12, 0.12), rng.uniform(-0.12, 0.12), 0.04])
        placed.append(PlacedMesh(3 * i, ball(0.04) if i % 2 else box((0.06, 0.04, 0.08)), T))
    return placed


def view() -> np.ndarray:
    return se3.look_at([0.15, -0.3, 0.3], [0.4, 0.0, 0.03])


def cropped(i: CameraIntrinsics, x: int, y: int, width: int, height: int) -> CameraIntrinsics:
    return CameraIntrinsics(width=width, height=height, fx=i.fx, fy=i.fy, cx=i.cx - x,
                            cy=i.cy - y, distortion=i.distortion)  # fmt: skip


@pytest.mark.parametrize("distortion", [np.zeros(5), LENS, [0.9, 0.3, 5e-4, -3e-4, 0.02, 1.2, 0.5]])
def test_hits_project_onto_their_own_pixel(distortion: np.ndarray) -> None:
    import cv2

    i = CameraIntrinsics.from_K(CAMERA.K, 320, 180, distortion)
    labels = LabelRenderer(clutter()).render(i, view())
    v, u = np.nonzero(labels.depth_m > 0)
    assert len(v) > 0.5 * 320 * 180
    xy, _ = camera.undistort(i, np.stack([u, v], -1))
    points = np.concatenate([xy, np.ones((len(u), 1))], -1) * labels.depth_m[v, u, None]
    # The points lie on the meshes: on the table top, or on or in the height of the objects.
    world = se3.transform(view(), points)
    on_table = labels.ids[v, u] < 0
    assert np.abs(world[on_table & (np.abs(world[:, 0] - 0.4) < 0.5), 2]).max() < 1e-5
    uv = cv2.projectPoints(points, np.zeros(3), np.zeros(3), i.K, i.distortion)[0][:, 0]
    assert np.abs(uv - np.stack([u, v], -1)).max() < 1e-3


def test_box_over_a_plane_covers_the_pixels_of_its_projection() -> None:
    # A camera straight down at 1 m over a face of 0.2 x 0.1 m at depth 0.9: at f = 90 px the face
    # spans [-10, 10] x [-5, 5] px about the principal point, which lies between pixel centres.
    i = CameraIntrinsics(width=64, height=48, fx=90, fy=90, cx=30.5, cy=20.5)
    placed = [
        PlacedMesh(-1, box((3, 3, 0.2)), se3.from_translation([0, 0, -0.1])),
        PlacedMesh(5, box((0.2, 0.1, 0.1)), se3.from_translation([0, 0, 0.05])),
    ]
    labels = LabelRenderer(placed).render(i, se3.look_at([0, 0, 1.0], [0, 0, 0]))
    assert labels.px_count_visib == {5: 200}
    assert labels.px_count_all == {5: 200}
    assert labels.visible_fraction == {5: 1.0}
    rows, columns = np.nonzero(labels.visible(5))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (16, 25, 21, 40)
    assert np.allclose(labels.depth_m[labels.visible(5)], 0.9, atol=1e-6)
    assert np.allclose(labels.depth_m[~labels.visible(5)], 1.0, atol=1e-6)


def test_amodal_is_the_render_of_the_object_alone() -> None:
    placed = clutter(n=8)
    labels = LabelRenderer(placed).render(CAMERA, view())
    assert min(labels.visible_fraction.values()) < 0.8  # there is something to complete
    for p in placed[1:]:
        alone = LabelRenderer([p]).render(CAMERA, view())
        assert np.array_equal(labels.amodal[p.instance], alone.ids == p.instance)
        assert not np.any(labels.visible(p.instance) & ~labels.amodal[p.instance])
        assert labels.px_count_all[p.instance] == int(labels.amodal[p.instance].sum())


def test_count_beyond_the_border_does_not_depend_on_the_crop() -> None:
    placed = clutter()
    whole = LabelRenderer(placed).render(CAMERA, view())
    for crop in ((100, 60, 120, 70), (140, 20, 110, 90)):
        part = LabelRenderer(placed).render(cropped(CAMERA, *crop), view())
        assert part.px_count_all == whole.px_count_all
        x, y, width, height = crop
        assert np.array_equal(part.ids, whole.ids[y : y + height, x : x + width])
        for p in placed[1:]:
            inside = whole.amodal[p.instance][y : y + height, x : x + width]
            assert np.array_equal(part.amodal[p.instance], inside)
    assert any(p.px_count_all[k] > p.amodal[k].sum() for p in (part,) for k in p.amodal)


def test_moving_world_and_camera_together_changes_nothing() -> None:
    placed = clutter()
    before = LabelRenderer(placed).render(CAMERA, view())
    M = se3.random_transform(np.random.default_rng(4), spread=5.0)
    moved = [PlacedMesh(p.instance, p.mesh, M @ p.T_world_obj) for p in placed]
    after = LabelRenderer(moved).render(CAMERA, M @ view())
    # Float32 may round a ray that grazes a silhouette the other way.
    same = before.ids == after.ids
    assert np.count_nonzero(~same) <= 3
    both = same & (before.depth_m > 0) & (after.depth_m > 0)
    assert np.quantile(np.abs(before.depth_m - after.depth_m)[both], 0.999) < 5e-6


def test_what_is_behind_the_camera_or_aside_is_counted_as_nothing() -> None:
    placed = [
        PlacedMesh(0, ball(0.05), se3.from_translation([-0.5, 0, 0])),
        PlacedMesh(1, ball(0.05), se3.from_translation([0.1, 0.0, 3.0])),
        PlacedMesh(2, ball(0.05), se3.from_translation([0.5, 0, 0])),
    ]
    labels = LabelRenderer(placed).render(CAMERA, se3.look_at([0, 0, 0], [1, 0, 0]))
    assert labels.px_count_all[0] == 0 and labels.px_count_all[1] == 0
    assert labels.visible_fraction[0] == 0.0
    assert set(np.unique(labels.ids)) == {-1, 2}


def test_an_object_around_the_camera_fills_the_canvas() -> None:
    i = CameraIntrinsics(width=40, height=30, fx=30, fy=30, cx=19.5, cy=14.5)
    room = PlacedMesh(0, box((2, 2, 2)), np.eye(4))
    labels = LabelRenderer([room]).render(i, se3.look_at([0, 0, 0], [1, 0, 0]))
    assert labels.amodal[0].all()
    assert labels.px_count_all[0] == 9 * 40 * 30


def test_pixels_without_a_ray_are_background() -> None:
    strong = CameraIntrinsics(width=160, height=120, fx=60, fy=60, cx=80, cy=60,
                              distortion=np.array([-0.3, 0.0, 0.0, 0.0]))  # fmt: skip
    gone = np.isnan(camera.ray_table(strong)[..., 0])
    assert 0 < gone.sum() < gone.size
    wall = PlacedMesh(0, box((0.01, 20, 20)), se3.from_translation([0.5, 0, 0]))
    labels = LabelRenderer([wall]).render(strong, se3.look_at([0, 0, 0], [1, 0, 0]))
    assert np.all(labels.ids[gone] == -1) and np.all(labels.depth_m[gone] == 0)
    assert np.all(labels.ids[~gone] == 0)
    assert labels.px_count_all[0] == int(np.count_nonzero(~gone))


def test_cast_rays_names_the_face_and_the_point() -> None:
    renderer = LabelRenderer(clutter())
    rays = np.array([[0.9, 0.4, 1, 0, 0, -1], [0.9, 0.4, 1, 0, 0, 1]], np.float32)
    hits = renderer.cast_rays(rays)
    assert hits.geometry.tolist() == [0, -1]
    assert hits.instance.tolist() == [-1, -1]
    assert hits.t[0] == pytest.approx(1.0, abs=1e-6) and np.isinf(hits.t[1])
    a, b, c = table().mesh.vertices[table().mesh.faces[hits.face[0]]] + [0.4, 0, -0.01]
    u, v = hits.uv[0]
    assert np.allclose(a + u * (b - a) + v * (c - a), [0.9, 0.4, 0], atol=1e-6)
    assert np.allclose(hits.normal[0], [0, 0, 1], atol=1e-6)


def test_mistakes_are_named() -> None:
    with pytest.raises(InputError, match="share an instance"):
        LabelRenderer([PlacedMesh(1, ball(0.1), np.eye(4)), PlacedMesh(1, ball(0.1), np.eye(4))])
    refused("they have: 0, 3", LabelRenderer(clutter(n=2)).render(CAMERA, view()).visible, 1)
    refused("from 0", PlacedMesh, -2, ball(0.1), np.eye(4))
