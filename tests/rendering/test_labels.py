"""Labels: exact rays, amodal masks, counts beyond the border, and occlusion."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from realsim.geometry import camera, se3
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.casting.pixel_caster import PixelCaster, body_of
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.rendering.rays import RayScene, rotated
from refusals import refused
from trimesh_solids import ball, box, solid

SIZE = (320, 240)
LENSES = {
    "none": np.zeros(5),
    "d405": np.array([-0.055, 0.062, 0.0005, -0.0007, -0.02]),
    "barrel": np.array([-0.3, 0.12, 0.0, 0.0, 0.0]),
    "pincushion": np.array([0.25, 0.1, 0.001, -0.002, 0.0]),
    "rational": np.array([0.9, 0.3, 5e-4, -3e-4, 0.02, 1.2, 0.5, 0.03]),
    "tangential": np.array([-0.1, 0.05, 0.01, -0.008, 0.0]),
}

MESHES = {
    "ball": ball(),
    "ring": solid(trimesh.creation.torus(0.05, 0.02)),
    "box": box((0.09, 0.05, 0.07)),
}


def a_camera(name: str, f: float = 210.0) -> CameraIntrinsics:
    K = np.array([[f, 0, SIZE[0] / 2 - 0.7], [0, f * 1.01, SIZE[1] / 2 + 0.4], [0, 0, 1]])
    return CameraIntrinsics.from_K(K, *SIZE, LENSES[name])


def a_scene(seed: int) -> list[PlacedMesh]:
    rng = np.random.default_rng(seed)
    placed = [PlacedMesh(-1, box((1.08, 1, 0.021)), se3.from_translation([0, 0, -0.0105]))]
    for i, kind in enumerate(("ball", "ring", "box", "ring", "ball", "box")):
        at = [*rng.uniform(-0.12, 0.12, 2), 0.04]
        T = se3.from_rt(se3.exp_so3(rng.normal(size=3)), at)
        placed.append(PlacedMesh(2 * i, MESHES[kind], T))
    return placed


def views(n: int, seed: int = 3) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    eyes = rng.normal(size=(n, 3)) * [1, 1, 0.4]
    eyes[:, 2] = np.abs(eyes[:, 2]) + 0.3
    eyes *= 0.42 / np.linalg.norm(eyes, axis=1, keepdims=True)
    return [se3.look_at(eye, rng.uniform(-0.03, 0.03, 3)) for eye in eyes]


CAMERA, VIEW = a_camera("d405"), views(1)[0]


@pytest.mark.parametrize("distortion", [LENSES["none"], LENSES["d405"], LENSES["rational"][:7]])
def test_hits_project_onto_their_own_pixel(distortion: np.ndarray) -> None:
    import cv2

    i = CameraIntrinsics.from_K(CAMERA.K, *SIZE, distortion)
    labels = LabelRenderer(a_scene(1)).render(i, VIEW)
    v, u = np.nonzero(labels.depth_m > 0)
    assert len(v) > 0.5 * 320 * 240
    xy, _ = camera.undistort(i, np.stack([u, v], -1))
    points = np.concatenate([xy, np.ones((len(u), 1))], -1) * labels.depth_m[v, u, None]
    # The points lie on the meshes: on the table top, or on or in the height of the objects.
    world = se3.transform(VIEW, points)
    on_table = labels.ids[v, u] < 0
    assert np.abs(world[on_table & (np.abs(world[:, 0]) < 0.5), 2]).max() < 1e-5
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
    placed = a_scene(1)
    labels = LabelRenderer(placed).render(CAMERA, VIEW)
    assert min(labels.visible_fraction.values()) < 0.8  # there is something to complete
    for p in placed[1:]:
        alone = LabelRenderer([p]).render(CAMERA, VIEW)
        assert np.array_equal(labels.amodal[p.instance], alone.ids == p.instance)
        assert not np.any(labels.visible(p.instance) & ~labels.amodal[p.instance])
        assert labels.px_count_all[p.instance] == int(labels.amodal[p.instance].sum())


def test_count_beyond_the_border_does_not_depend_on_the_crop() -> None:
    placed = a_scene(1)
    whole = LabelRenderer(placed).render(CAMERA, VIEW)
    for x, y, width, height in ((100, 60, 120, 70), (140, 20, 110, 90)):
        at = (CAMERA.cx - x, CAMERA.cy - y)
        cropped = replace(CAMERA, width=width, height=height, cx=at[0], cy=at[1])
        part = LabelRenderer(placed).render(cropped, VIEW)
        assert part.px_count_all == whole.px_count_all
        assert np.array_equal(part.ids, whole.ids[y : y + height, x : x + width])
        for p in placed[1:]:
            inside = whole.amodal[p.instance][y : y + height, x : x + width]
            assert np.array_equal(part.amodal[p.instance], inside)
    assert any(p.px_count_all[k] > p.amodal[k].sum() for p in (part,) for k in p.amodal)


def test_moving_world_and_camera_together_changes_nothing() -> None:
    placed = a_scene(1)
    before = LabelRenderer(placed).render(CAMERA, VIEW)
    M = se3.random_transform(np.random.default_rng(4), spread=5.0)
    moved = [PlacedMesh(p.instance, p.mesh, M @ p.T_world_obj) for p in placed]
    after = LabelRenderer(moved).render(CAMERA, M @ VIEW)
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
    scene = a_scene(1)
    rays = np.array([[0.5, 0.4, 1, 0, 0, -1], [0.5, 0.4, 1, 0, 0, 1]], np.float32)
    hits = LabelRenderer(scene).cast_rays(rays)
    assert hits.geometry.tolist() == [0, -1]
    assert hits.instance.tolist() == [-1, -1]
    assert hits.t[0] == pytest.approx(1.0, abs=1e-6) and np.isinf(hits.t[1])
    table = scene[0].mesh
    a, b, c = table.vertices[table.faces[hits.face[0]]] + scene[0].T_world_obj[:3, 3]
    u, v = hits.uv[0]
    assert np.allclose(a + u * (b - a) + v * (c - a), [0.5, 0.4, 0], atol=1e-6)
    assert np.allclose(hits.normal[0], [0, 0, 1], atol=1e-6)


def test_mistakes_are_named() -> None:
    refused("share an instance", LabelRenderer, [PlacedMesh(1, ball(0.1), np.eye(4))] * 2)
    refused("they have: 0, 2, 4", LabelRenderer(a_scene(1)).render(CAMERA, VIEW).visible, 1)
    refused("from 0", PlacedMesh, -2, ball(0.1), np.eye(4))


# --- the same hits as an independent ray caster, through any lens --------------------------------


def embree(placed: list[PlacedMesh], lens: CameraIntrinsics, T: np.ndarray):
    rays = camera.ray_table(lens)
    hits = RayScene(placed).cast(T[:3, 3], rotated(rays, T[:3, :3]).reshape(-1, 3))
    shape = rays.shape[:2]
    return np.where(np.isfinite(hits.t), hits.t, 0).reshape(shape), hits.geometry.reshape(shape)


@pytest.mark.parametrize("name", LENSES)
def test_an_independent_caster_sees_the_same_through_every_lens(name: str) -> None:
    lens = a_camera(name)
    caster_of = a_scene(1)
    ours = PixelCaster(caster_of)
    different = seen = 0
    for T in views(4):
        hits = ours.cast(lens, T)
        depth, geometry = embree(caster_of, lens, T)
        differs = hits.geometry != geometry
        different += int(differs.sum())
        seen += int((hits.geometry > 0).sum())
        same = ~differs & (geometry >= 0)
        # Where a ray grazes a surface, float32 moves the hit along it.
        assert np.quantile(np.abs(hits.depth_m - depth)[same], 0.999) < 1e-5
    assert seen > 8000
    assert different <= max(2, 1e-4 * seen)


def test_a_lens_that_folds_back_shows_nothing_twice() -> None:
    # A wide picture through a barrel lens whose polynomial turns round inside the image.
    K = np.array([[90.0, 0, 159.3], [0, 91.0, 120.4], [0, 0, 1]])
    folding = CameraIntrinsics.from_K(K, *SIZE, np.array([-0.3, 0.02, 0.0, 0.0, 0.0]))
    radius = camera.turning_radius(folding)
    assert 1.0 < radius < 2.0
    labels = LabelRenderer(a_scene(3)).render(folding, VIEW)
    assert 0.02 < labels.unknown.mean() < 0.9
    assert not np.any(labels.ids[labels.unknown] >= 0) and not labels.depth_m[labels.unknown].any()
    known = camera.ray_table(folding)[~labels.unknown].astype(np.float64)
    assert np.linalg.norm(known[:, :2], axis=1).max() < radius
    # Every pixel inside the greatest distorted radius has a ray, none outside has.
    centre = [folding.cx, folding.cy]
    out = np.linalg.norm((camera.pixel_grid(*SIZE) - centre) / [folding.fx, folding.fy], axis=-1)
    rim = camera.distort(folding.distortion, [radius, 0.0])[0]
    sure = np.abs(out - rim) > 1e-3
    assert np.array_equal(labels.unknown[sure], (out >= rim)[sure])


def test_a_large_triangle_bends_with_the_lens() -> None:
    # One triangle across the whole picture: its box on the image is not that of its corners.
    corners = np.array([[-0.6, 0.0, 0.4], [0.6, 0.02, 0.4], [0.0, 0.45, 0.4]])
    sheet = [PlacedMesh(0, Mesh(vertices=corners, faces=np.array([[0, 1, 2]])), np.eye(4))]
    for name in LENSES:
        lens = a_camera(name, f=120.0)
        hits = PixelCaster(sheet).cast(lens, np.eye(4))
        _, geometry = embree(sheet, lens, np.eye(4))
        assert np.count_nonzero(hits.geometry != geometry) <= 1, name
        assert (hits.geometry == 0).sum() > 3000


def test_object_coordinates_lie_on_the_object_and_come_back_to_the_camera() -> None:
    placed = a_scene(4)
    labels = LabelRenderer(placed).render(CAMERA, VIEW)
    coordinates = labels.object_coordinates()
    assert not coordinates[labels.ids < 0].any()
    rays = camera.ray_table(CAMERA).astype(np.float64)
    for p in placed[1:]:
        mine = labels.ids == p.instance
        low, high = p.mesh.bounds
        if not mine.any():
            continue
        on = coordinates[mine].astype(np.float64)
        assert np.all(on > low - 1e-6) and np.all(on < high + 1e-6)
        back = se3.transform(se3.invert(VIEW) @ p.T_world_obj, on)
        assert np.abs(back - rays[mine] * labels.depth_m[mine, None]).max() < 1e-6


def test_normals_are_those_of_the_faces_and_look_at_the_camera() -> None:
    alone = PlacedMesh(0, MESHES["ball"], se3.from_translation([0, 0, 0.3]))
    labels = LabelRenderer([alone]).render(CAMERA, np.eye(4))
    normals = labels.normals()
    rays = camera.ray_table(CAMERA)
    seen = labels.ids == 0
    assert not normals[~seen].any()
    n = normals[seen].astype(np.float64)
    assert np.allclose(np.linalg.norm(n, axis=1), 1, atol=1e-5)
    assert np.all(np.einsum("ij,ij->i", n, rays[seen]) <= 0)
    outward = rays[seen] * labels.depth_m[seen, None] - [0, 0, 0.3]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert np.degrees(np.arccos(np.einsum("ij,ij->i", n, outward).min())) < 4


def test_turning_a_face_round_changes_no_label() -> None:
    # Only closed meshes may skip faces seen from behind; a mesh turned inside out must not.
    placed = a_scene(5)
    turned = [
        PlacedMesh(p.instance, replace(p.mesh, faces=p.mesh.faces[:, ::-1]), p.T_world_obj)
        for p in placed
    ]
    assert body_of(placed[1].mesh).is_solid and not body_of(turned[1].mesh).is_solid
    a, b = (LabelRenderer(s).render(CAMERA, VIEW) for s in (placed, turned))
    assert np.array_equal(a.ids, b.ids) and np.array_equal(a.depth_m, b.depth_m)
    assert a.px_count_all == b.px_count_all
    assert np.array_equal(a.normals(), b.normals())


def test_a_mesh_with_a_hole_is_seen_from_within() -> None:
    whole = MESHES["ball"]
    top = whole.vertices[whole.faces].mean(1)[:, 2] > 0.03
    bowl = replace(whole, faces=whole.faces[~top])
    assert body_of(whole).is_solid and not body_of(bowl).is_solid
    T = se3.look_at([0, 0, 0.3], [0, 0, 0])
    labels = LabelRenderer([PlacedMesh(0, bowl, np.eye(4))]).render(a_camera("none"), T)
    middle = labels.depth_m[SIZE[1] // 2, SIZE[0] // 2]
    assert abs(middle - 0.35) < 2e-3  # the bottom of the bowl, not its missing lid


def test_a_camera_inside_an_object_is_said() -> None:
    scene = a_scene(6)
    room = PlacedMesh(9, box((5.4, 3, 4.2)), np.eye(4))
    assert LabelRenderer(scene).render(CAMERA, VIEW).camera_inside == ()
    labels = LabelRenderer([*scene, room]).render(CAMERA, VIEW)
    assert labels.camera_inside == (9,)
    assert labels.amodal[9].all()  # its inner walls fill the picture
    # Inside its box but outside its body is not inside.
    hole = PlacedMesh(3, MESHES["ring"], VIEW)
    assert LabelRenderer([hole]).render(CAMERA, VIEW).camera_inside == ()
