"""Grasps in view and frame labels: laws and known answers on boxes."""

from dataclasses import replace

import numpy as np
import pytest

from map_formulas import coordinate_counts, normal_counts
from plain_meshes import box
from realsim import CameraIntrinsics, GraspSet, ObjectPose
from realsim.arrays import Array
from realsim.formats.bop.labels import bbox_of
from realsim.geometry import camera, se3
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.rendering.rays import BACKGROUND
from realsim_sim_bridge.annotation import frame_maps
from realsim_sim_bridge.annotation.config import OccluderConfig, SightConfig
from realsim_sim_bridge.annotation.files import (
    GraspsInView,
    GraspVisibility,
    grasps_in_view,
    in_image,
)
from realsim_sim_bridge.annotation.frame_labels import (
    depth_agreement,
    label_object,
    unknown_occluder,
)
from realsim_sim_bridge.annotation.unmodelled import object_masks
from tried_grasps import plain_grasps

INTRINSICS = CameraIntrinsics(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
SIDE = 0.05
CUBE = box((SIDE, SIDE, SIDE))


def grasp_set(Ts: Array, width: float = SIDE) -> GraspSet:
    n = len(Ts)
    return plain_grasps(
        Ts, widths_m=np.full(n, width), scores=np.linspace(0, 1, n), base_scores=np.zeros(n),
        reachable=np.arange(n) % 2 == 0,
    )  # fmt: skip


# A grasp from above: z (approach) down, y (closing) along the world's y, 15 mm below the top.
TOP_GRASP = se3.from_rt(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, SIDE / 2 - 0.015])


def seen_from(eye: list[float], *walls: PlacedMesh) -> GraspsInView:
    renderer = LabelRenderer([PlacedMesh(0, CUBE, np.eye(4)), *walls])
    T = se3.look_at(eye, [0, 0, 0])
    grasps = grasp_set(TOP_GRASP[None])
    return grasps_in_view(renderer, INTRINSICS, T, [(np.eye(4), grasps)], SightConfig())[0]


def test_from_above_both_contacts_are_seen() -> None:
    assert seen_from([0.0, 0.0, 0.5]).visibility[0] == GraspVisibility.VISIBLE


def test_from_the_side_of_one_finger_only_that_contact_is_seen() -> None:
    view = seen_from(list(0.5 * TOP_GRASP[:3, 1] + [0.0, 0.0, 0.1]))  # the grasp's +y in the world
    np.testing.assert_array_equal(view.contact_seen[0], [False, True])
    assert view.visibility[0] == GraspVisibility.PARTLY


def test_grasps_move_with_the_world() -> None:
    rng = np.random.default_rng(1)
    W = se3.random_transform(rng, spread=0.3)
    Ts = TOP_GRASP @ se3.from_rt(se3.exp_so3(rng.normal(size=(40, 3)) * 0.8), np.zeros((40, 3)))
    T = se3.look_at([0.2, 0.1, 0.4], [0, 0, 0])
    a, b = (
        grasps_in_view(
            LabelRenderer([PlacedMesh(0, CUBE, X)]), INTRINSICS, X @ T, [(X, grasp_set(Ts))],
            SightConfig(),
        )[0]
        for X in (np.eye(4), W)
    )  # fmt: skip
    np.testing.assert_allclose(a.Ts_cam_grasp, b.Ts_cam_grasp, atol=1e-12)
    np.testing.assert_array_equal(a.visibility, b.visibility)
    assert len(set(a.visibility.tolist())) > 1


def test_in_image_agrees_with_projection_and_refuses_folded_points() -> None:
    barrel = replace(INTRINSICS, distortion=np.array([-0.35, 0.05, 0, 0, 0]))
    rng = np.random.default_rng(2)
    p = rng.uniform([-2, -2, -0.5], [2, 2, 1.0], (4000, 3))
    for cam in (INTRINSICS, barrel):
        inside = in_image(cam, p)
        assert np.all(p[inside, 2] > 0)
        uv = camera.project(cam, p[inside])
        assert np.all(np.abs(uv - [79.5, 59.5]) <= [80.0, 60.0])
        # Nothing far outside the field of view may be taken for a point in the image.
        assert np.max(np.abs(p[inside, :2] / p[inside, 2:])) < 1.0
    folded = np.array([[2.4, 0.0, 1.0]])
    assert np.abs(camera.project(barrel, folded)[0, 0] - 79.5) < 2000
    assert not in_image(barrel, folded)[0]


def label(eye: list[float], target: list[float], depth_error: float = 0.0):
    pose = ObjectPose(obj_id=1, instance=0, T_world_obj=np.eye(4))
    T = se3.look_at(eye, target)
    labels = LabelRenderer([PlacedMesh(0, CUBE, np.eye(4))]).render(INTRINSICS, T)
    depth = np.where(labels.depth_m > 0, labels.depth_m + depth_error, 0).astype(np.float32)
    masks = object_masks(labels, 0)
    rendered, measured = labels.depth_m[masks.window], depth[masks.window]
    agreement = depth_agreement(masks.rendered, rendered, measured, 0.01)
    unknown = unknown_occluder(masks, rendered, measured, agreement, OccluderConfig())
    return label_object(
        pose, (CUBE, CUBE.bounds), masks, labels, depth, (INTRINSICS, T), (agreement, unknown)
    )


def test_wrong_depth_is_named_and_its_bias_measured() -> None:
    for error, share in ((-0.03, "nearer"), (0.03, "farther")):
        got = label([0.1, 0.2, 0.4], [0, 0, 0], error)
        assert getattr(got.agreement, share) == 1.0 and got.agreement.agree == 0.0
        assert np.isnan(got.agreement.bias_m)
    got = label([0.1, 0.2, 0.4], [0, 0, 0], 0.004)
    assert got.agreement.bias_m == pytest.approx(0.004, abs=1e-6)


def test_a_box_beyond_the_border_is_where_a_wider_camera_sees_it() -> None:
    eye, target = [0.0, -0.05, 0.3], [0.14, 0.03, 0.0]
    cut = label(eye, target)
    wide = replace(INTRINSICS, width=480, height=360, cx=239.5, cy=179.5)
    T = se3.look_at(eye, target)
    ids = LabelRenderer([PlacedMesh(0, CUBE, np.eye(4))]).render(wide, T).ids
    x, y, w, h = bbox_of(ids == 0)
    assert cut.info["px_count_visib"] < cut.info["px_count_all"] == np.sum(ids == 0)
    np.testing.assert_allclose(cut.info["bbox_obj"], (x - 160, y - 120, w, h), atol=1.01)
    assert cut.info["bbox_obj"][1] + cut.info["bbox_obj"][3] > 119


def test_an_object_out_of_view_has_no_box() -> None:
    got = label([0.0, 0.0, 0.5], [5.0, 0.0, 0.0])
    assert got.info["bbox_obj"] == got.info["bbox_visib"] == [-1, -1, -1, -1]
    assert got.info["px_count_visib"] == 0 and got.info["visib_fract"] == 0.0
    assert np.isnan(got.agreement.measured)


# --- Maps as counts: the same as what the formulas make of the labels' own maps.

LENS = replace(INTRINSICS, distortion=np.array([-0.05, 0.06, 0.0005, -0.0007, -0.02]))


def test_counts_equal_those_of_the_float_maps() -> None:
    rng = np.random.default_rng(0)
    placed = [
        PlacedMesh(i, box(rng.uniform(0.02, 0.08, 3)),
                   se3.exp([*rng.normal(size=3), *rng.uniform(-0.08, 0.08, 3)]))
        for i in range(3)
    ]  # fmt: skip
    placed.append(PlacedMesh(BACKGROUND, box((1, 1, 0.01)), se3.from_translation([0, 0, -0.15])))
    T = se3.look_at([0.1, 0.2, 0.5], [0, 0, 0])
    labels = LabelRenderer(placed).render(LENS, T)
    window = (slice(10, 110), slice(20, 150))
    seen = (labels.ids[window] >= 0) & (rng.random((100, 130)) < 0.9)
    boxes = np.stack([p.mesh.bounds for p in placed])
    got = frame_maps.coordinate_counts(labels, window, seen, boxes)
    points = labels.object_coordinates()[window]
    for k in range(3):
        mask = seen & (labels.ids[window] == k)
        assert mask.any()
        wanted = coordinate_counts(points[mask], *boxes[k])
        # Float32 products may fall on either side of a half.
        assert np.max(np.abs(got[mask].astype(int) - wanted)) <= 1
    assert not got[~seen].any()
    normals = frame_maps.normal_counts(labels).astype(int)
    assert np.max(np.abs(normals - normal_counts(labels.normals()))) <= 1
    assert np.array_equal(normals.any(axis=-1), labels.geometry >= 0)
