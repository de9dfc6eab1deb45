"""What the review shows: the cloud's levels, the models as they are sent, the grasps that pass."""

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from plain_meshes import box
from realsim import CameraIntrinsics, GraspSet, InputError, Mesh, View
from realsim.geometry import camera, depth, se3
from realsim.images import png_bytes
from realsim.models.simplify import deviation
from realsim.rendering import overlay
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.review.content import clouds
from realsim.review.content.config import SceneConfig
from realsim.review.content.content import SceneContent
from realsim.review.content.meshes import glb_of, within_budget
from realsim.review.content.views import Region, region_of, strided
from realsim.review.drawing import grasp_drawing
from realsim.review.drawing.grasp_drawing import GraspFilter, passing
from realsim.review.window.panel_grasps import legend_html
from realsim.store import SessionStore, save_grasps
from refusals import refused
from reviewed_boxes import CAMERAS, CONFIG, boxes_session, grasp_set


def measured(store: SessionStore, region: Region) -> np.ndarray:
    """All measured points in world, in double."""
    parts = []
    for view in store.session.views:
        points, _ = depth.points_from_depth(store.depth_m(view.index), store.session.intrinsics)
        parts.append(se3.transform(np.asarray(view.T_world_cam), points))
    points = np.concatenate(parts)
    return points[region.holds(points)]


def nearest_m(points: np.ndarray, to: np.ndarray) -> np.ndarray:
    from scipy.spatial import KDTree

    return np.asarray(KDTree(to).query(points)[0])


# --- the cloud --------------------------------------------------------------------------------


def test_every_point_of_every_level_is_within_half_a_voxel_of_a_measured_one(
    store: SessionStore, shown: SceneContent
) -> None:
    cloud = shown.cloud
    assert len(cloud) > 3000 and cloud.points.dtype == np.float32
    distances = nearest_m(cloud.points.astype(np.float64), measured(store, shown.region))
    assert distances.max() <= CONFIG.voxel_m / 2 + 1e-6
    assert shown.region.holds(cloud.points.astype(np.float64) * (1 - 1e-7)).mean() > 0.999


def test_levels_grow_and_no_point_comes_twice(shown: SceneContent) -> None:
    cloud = shown.cloud
    assert list(cloud.ends) == sorted(set(cloud.ends)) and cloud.ends[-1] == len(cloud)
    assert 100 <= cloud.ends[0] <= CONFIG.coarse_points
    assert len(np.unique(cloud.points, axis=0)) == len(cloud)


@pytest.mark.parametrize("most", [150, 10**9])
def test_pieces_are_the_cloud_in_order_and_no_message_is_large(
    shown: SceneContent, most: int
) -> None:
    pieces = shown.cloud.pieces(most, 700)
    together = np.concatenate([np.arange(len(shown.cloud))[p] for p in pieces])
    np.testing.assert_array_equal(together, np.arange(min(most, len(shown.cloud))))
    assert pieces[0].stop <= shown.cloud.ends[0]
    assert all(0 < p.stop - p.start <= 700 for p in pieces)


@pytest.mark.parametrize("voxel_m", [0.05, 4e-7])
def test_points_are_grouped_by_voxels_and_those_seen_most_often_stay(voxel_m: float) -> None:
    points = np.random.default_rng(0).normal(0, 0.05, (4000, 3)).astype(np.float32)
    points[1000:2000] = points[:1000]
    order, counts = clouds._by_voxel(points, voxel_m)  # pyright: ignore[reportPrivateUsage]
    cells = np.floor(points[order] / np.float64(voxel_m))
    _, expected = np.unique(cells, axis=0, return_counts=True)
    np.testing.assert_array_equal(counts, expected)
    assert len(np.unique(order)) == len(points)
    kept = clouds._greatest(counts, 40)  # pyright: ignore[reportPrivateUsage]
    assert kept.sum() == 40 and counts[kept].min() >= counts[~kept].max(initial=0)


# --- the scene --------------------------------------------------------------------------------


def test_without_objects_the_region_is_where_the_cameras_look() -> None:
    region = region_of([], [View(index=i, T_world_cam=T) for i, T in enumerate(CAMERAS)], 0.2)
    np.testing.assert_allclose(region.center, [0.5, 0.0, 0.03], atol=1e-9)


def test_a_strided_camera_sees_the_same_points() -> None:
    lens = CameraIntrinsics(
        width=161, height=121, fx=150.0, fy=152.0, cx=80.2, cy=59.1,
        distortion=np.array([-0.05, 0.06, 3e-4, 5e-4, -0.02]),
    )  # fmt: skip
    for stride in (1, 2, 3, 7):
        small = strided(lens, stride)
        rays = camera.ray_table(lens)[::stride, ::stride]
        np.testing.assert_allclose(camera.ray_table(small), rays, atol=1e-6)


def test_a_missing_model_is_named(tmp_path: Path) -> None:
    store = boxes_session(tmp_path / "boxes")
    (store.folder / "models/obj_000007.ply").unlink()
    refused(r"objects 7.*it has 1, 9", SceneContent.load, store, CONFIG)


def test_views_with_damaged_images_and_grasps_of_another_object_are_left_out_and_named(
    tmp_path: Path, shown: SceneContent
) -> None:
    store = boxes_session(tmp_path / "boxes")
    photograph = store.path("rgb/000001.png")
    photograph.write_bytes(photograph.read_bytes()[:900])
    store.path("depth/000003.png").write_bytes(b"")
    store.add_view(View(index=7, T_world_cam=CAMERAS[0]), store.rgb(0))
    store.path("rgb/000007.png").unlink()
    store.path("depth/000002.png").write_bytes(png_bytes(np.full((60, 80), 4000, np.uint16)))
    save_grasps(store, grasp_set(7, 0))  # of what was instance 0 before
    left = SceneContent.load(SessionStore.open(store.folder), CONFIG)
    assert sorted(left.damaged) == [1, 2, 3, 7] and sorted(left.thumbnails) == [0, 2, 3]
    assert [g.obj_id for g in left.grasp_sets] == [1, 7]
    *damaged, grasps = left.remarks
    names = ("rgb/000001", "(60, 80)", "depth/000003", "View 7")
    for said, name in zip(damaged, names, strict=True):
        assert "is left out" in said and name in said
    assert "of 1 object stay out" in grasps
    found = nearest_m(left.cloud.points.astype(float), shown.cloud.points.astype(float))
    assert 0 < len(left.cloud) < len(shown.cloud) and found.max() < CONFIG.voxel_m


def test_an_unknown_view_or_model_is_named(shown: SceneContent) -> None:
    refused(r"view 77.*0, 1, 2, 3", shown.pose_of, 77)
    with pytest.raises(InputError, match="8"):
        _ = shown.meshes[8]
    np.testing.assert_array_equal(shown.pose_of(2), CAMERAS[2])


@pytest.mark.parametrize(
    ("settings", "wrong"),
    [(SceneConfig, {"voxel_m": 0.0}), (SceneConfig, {"coarse_points": 0}),
     (SceneConfig, {"thumbnail_quality": 101}), (GraspFilter, {"stage": 5}),
     (GraspFilter, {"stage": -1}), (GraspFilter, {"min_label": 1.5})],
)  # fmt: skip
def test_settings_that_show_nothing_are_refused(settings: Any, wrong: dict[str, float]) -> None:
    with pytest.raises(InputError):
        settings(**wrong)


# --- grasps -----------------------------------------------------------------------------------


def with_p_hold(grasps: GraspSet) -> GraspSet:
    n = len(grasps)
    p = np.random.default_rng(2).random(n)
    draws = np.where(np.arange(n) % 5 == 0, 6.0, 32.0)
    measures = {"p_hold": p, "p_hold_draws": draws, "p_hold_error": np.sqrt(p * (1 - p) / draws)}
    return replace(grasps, measures=measures)


def test_what_passes_is_what_was_asked_for() -> None:
    grasps = grasp_set(1, 0)
    np.testing.assert_array_equal(passing(grasps, GraspFilter()), np.arange(40))
    rows = passing(grasps, GraspFilter(stage=3, min_label=0.4, reachable_only=True))
    expected = [
        r for r in range(40)
        if grasps.base_scores[r] >= 0.75 and grasps.scores[r] >= 0.4 and grasps.reachable[r]
    ]  # fmt: skip
    assert rows.tolist() == expected and expected
    assert len(passing(grasps, GraspFilter(instance=5))) == 0
    told = with_p_hold(grasps)
    rows = passing(told, GraspFilter(min_label=0.4))
    assert rows.tolist() == np.flatnonzero(told.measures["p_hold"] >= 0.4).tolist() and len(rows)
    lost = passing(grasps, GraspFilter(failure="LIFT"))
    assert len(lost) and all("lift" in grasps.failures[r] for r in lost)


def test_too_many_grasps_are_thinned_evenly_over_scores_and_objects() -> None:
    sets = [grasp_set(1, 0, 400), grasp_set(7, 3, 100)]
    found = dict((g.instance, rows) for g, rows in grasp_drawing.chosen_grasps(
        sets, GraspFilter(), 50))  # fmt: skip
    assert len(found[0]) == 40 and len(found[3]) == 10
    scores = sets[0].scores[found[0]]
    assert np.nanmin(scores) < 0.05 and np.nanmax(scores) > 0.95
    choices = grasp_drawing.failure_choices(sets)
    words = ["any failure", "none: it held", "close", "lift", "oscillate", "pendulum"]
    assert list(choices.values())[:6] == words
    counts = {k: sum(len(passing(g, GraspFilter(failure=w))) for g in sets)
              for k, w in choices.items()}  # fmt: skip
    assert all(name.endswith(f"({n})") and n > 0 for name, n in counts.items())
    assert sum(list(counts.values())[:2]) == 500


def test_visible_grasps_are_those_with_a_contact_before_the_measured_surface(
    shown: SceneContent,
) -> None:
    for view in range(len(CAMERAS)):
        seen = grasp_drawing.visible_grasps(shown, view)
        assert set(seen) == {0, 3}
        for grasps in shown.grasp_sets:
            for row in range(len(grasps)):
                margins = margins_m(shown, view, grasps, row)
                if any(m < 0.008 for m in margins):
                    assert row in seen[grasps.instance]
                if all(m > 0.02 for m in margins):
                    assert row not in seen[grasps.instance]


def margins_m(shown: SceneContent, view: int, grasps: GraspSet, row: int) -> list[float]:
    """Return how far behind the first surface the contacts of a grasp are, by casting rays."""
    T = shown.scene.object(grasps.instance).T_world_obj @ grasps.Ts_obj_grasp[row]
    half = grasps.widths_m[row] / 2 * T[:3, 1]
    depth_m = shown.store.depth_m(view)
    found: list[float] = []
    for contact in (T[:3, 3] - half, T[:3, 3] + half):
        p = se3.transform(se3.invert(CAMERAS[view]), contact[None])[0]
        u, v = np.rint(camera.project(shown.intrinsics, p[None])[0]).astype(int)
        found.append(float(p[2] - depth_m[v, u]))
    return found


def test_a_moved_object_takes_its_grasps_out_of_sight(shown: SceneContent) -> None:
    seen = grasp_drawing.visible_grasps(shown, 0, {0: se3.from_translation([0.5, 0.0, -1.0])})
    assert len(seen[0]) == 0 and len(seen[3]) > 0


def test_the_gripper_is_as_wide_as_the_grasp() -> None:
    vertices, faces = grasp_drawing.gripper_mesh()
    assert len(faces) <= 24 and faces.max() < len(vertices)
    for width in np.random.default_rng(1).uniform(0.01, 0.1, 5):
        scaled = vertices * grasp_drawing.gripper_scales([width])[0]
        inner = np.abs(scaled[np.isclose(scaled[:, 2], 0.0)][:, 1]).min()
        assert inner == pytest.approx(width / 2, rel=1e-5)
        assert scaled[:, 2].max() == pytest.approx(0.0, abs=1e-9)
        assert scaled[:, 2].min() == pytest.approx(-0.065, abs=1e-6)


def test_colours_are_those_of_the_label_and_pale_where_it_is_not_sure() -> None:
    grasps = with_p_hold(grasp_set(1, 0))
    rgb = overlay.grasp_rgb(grasps, np.arange(40)).astype(int)
    for row in range(40):
        color = np.array(overlay.score_color(float(grasps.measures["p_hold"][row])))
        wanted = color if not grasps.unsure[row] else 0.4 * color + 0.6 * 255
        np.testing.assert_allclose(rgb[row], wanted, atol=1)
    assert 0 < grasps.unsure.sum() < 40
    plain = grasp_set(1, 0)
    assert not plain.unsure.any() and "score" in legend_html([plain])
    assert "p_hold" in legend_html([grasps]) and "few draws" in legend_html([grasps])


# --- Models as the browser takes them: few triangles, the same outline, glTF that others read.

CAMERA = CameraIntrinsics(width=400, height=300, fx=900.0, fy=900.0, cx=199.5, cy=149.5)


def dented_ball(faces: int) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=round(np.log(faces / 20) / np.log(4)))
    v = np.asarray(ball.vertices)
    v = v * (1 + 0.15 * np.sin(4 * v[:, :1]) * np.cos(3 * v[:, 1:2])) * [0.05, 0.04, 0.06]
    rgb = np.clip(255 * (v / 0.12 + 0.5), 0, 255).astype(np.uint8)
    return Mesh(vertices=v, faces=np.asarray(ball.faces, np.int32), colors=rgb)


def textured_square() -> Mesh:
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]], float)
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32, :, 0], texture[32:, :, 2] = 250, 250  # red above, blue below
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Mesh(vertices=vertices, faces=faces, uv=uv, texture=texture)


def loaded(glb: bytes) -> trimesh.Trimesh:
    scene = trimesh.load(io.BytesIO(glb), file_type="glb", process=False)
    assert isinstance(scene, trimesh.Scene)
    return next(iter(scene.geometry.values()))


def outline(mesh: Mesh, T_world_cam: np.ndarray) -> np.ndarray:
    return LabelRenderer([PlacedMesh(0, mesh, np.eye(4))]).render(CAMERA, T_world_cam).ids == 0


def test_a_decimated_mesh_keeps_its_outline_and_its_colours() -> None:
    mesh = dented_ball(20 * 4**5)
    few = within_budget(mesh, SceneConfig(most_triangles=5_000))
    assert len(few.faces) <= 7_500 < len(mesh.faces)
    assert deviation(mesh, few) < 1e-3 and deviation(mesh, few, quantile=0.95) < 3e-4
    rng = np.random.default_rng(0)
    for _ in range(2):
        eye = rng.normal(size=3)
        T = se3.look_at(0.35 * eye / np.linalg.norm(eye), [0.0, 0.0, 0.0])
        a, b = outline(mesh, T), outline(few, T)
        assert np.sum(a & b) / np.sum(a | b) > 0.995
    assert few.colors is not None
    assert np.abs(few.colors - np.clip(255 * (few.vertices / 0.12 + 0.5), 0, 255)).max() < 8


def test_a_mesh_is_not_touched_below_its_budget_and_textures_have_a_larger_one() -> None:
    square = textured_square()
    assert within_budget(square, SceneConfig(most_triangles=1, most_textured_triangles=2)) is square
    plain = box((0.1, 0.1, 0.1), (180, 60, 40))
    assert within_budget(plain, SceneConfig(most_triangles=12)) is plain


def test_the_gltf_has_the_same_surface_for_another_reader() -> None:
    mesh = dented_ball(20 * 4**3)
    read = loaded(glb_of(mesh, 1024))
    np.testing.assert_allclose(np.asarray(read.vertices), mesh.vertices, atol=1e-7)
    np.testing.assert_array_equal(np.asarray(read.faces), mesh.faces)


def test_vertex_colours_are_linear_light_as_gltf_has_them() -> None:
    import json

    glb = glb_of(box((0.1, 0.1, 0.1), (0, 128, 255)), 1024)
    length = int.from_bytes(glb[12:16], "little")
    tree = json.loads(glb[20 : 20 + length])
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    view = tree["bufferViews"][accessor["bufferView"]]
    start = 20 + length + 8 + view["byteOffset"]
    values = np.frombuffer(glb[start : start + view["byteLength"]], "<u2").reshape(-1, 4)
    assert accessor["normalized"] and accessor["count"] == 8
    np.testing.assert_allclose(values[0] / 65535, [0, 0.2158605, 1, 1], atol=1e-5)


def test_a_texture_is_upright_and_no_larger_than_asked() -> None:
    read = loaded(glb_of(textured_square(), 32))
    image = np.asarray(read.visual.material.baseColorTexture.convert("RGB")).astype(int)
    assert image.shape[:2] == (32, 32)
    assert image[4, 16, 0] > 200 > image[4, 16, 2] and image[28, 16, 2] > 200
    # trimesh turns glTF's V back upwards: the corner of v = 1 is the red edge.
    np.testing.assert_allclose(np.asarray(read.visual.uv), textured_square().uv, atol=1e-6)
