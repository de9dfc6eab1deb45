"""Grasps in view, frame labels, and things that are not in the scene: known answers on boxes."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from map_formulas import coordinate_counts, normal_counts
from plain_meshes import box
from realsim import CameraIntrinsics, GraspSet, ObjectModel, ObjectPose
from realsim.arrays import Array, Array32
from realsim.formats.bop.labels import bbox_of
from realsim.geometry import camera, se3
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.labels import LabelRenderer, Labels, PlacedMesh
from realsim.rendering.rays import BACKGROUND
from realsim_sim_bridge.annotation import frame_labels
from realsim_sim_bridge.annotation.annotate import frame_files
from realsim_sim_bridge.annotation.config import AnnotationConfig, OccluderConfig, SightConfig
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
from realsim_sim_bridge.annotation.inputs import FrameInputs, FrameView, table_slab
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
    got = frame_labels.coordinate_counts(labels, window, seen, boxes)
    points = labels.object_coordinates()[window]
    for k in range(3):
        mask = seen & (labels.ids[window] == k)
        assert mask.any()
        wanted = coordinate_counts(points[mask], *boxes[k])
        # Float32 products may fall on either side of a half.
        assert np.max(np.abs(got[mask].astype(int) - wanted)) <= 1
    assert not got[~seen].any()
    normals = frame_labels.normal_counts(labels).astype(int)
    assert np.max(np.abs(normals - normal_counts(labels.normals()))) <= 1
    assert np.array_equal(normals.any(axis=-1), labels.geometry >= 0)


# --- Things that are not in the scene: found in the measured depth, and nothing else taken for one.


CAMERA = CameraIntrinsics(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
MODELS = {
    1: ObjectModel(obj_id=1, name="mug", mesh=box((0.08, 0.08, 0.10))),
    2: ObjectModel(obj_id=2, name="book", mesh=box((0.16, 0.11, 0.03))),
}
PLACES = {1: [-0.07, 0.0, 0.05], 2: [0.09, 0.02, 0.015]}
OBJECTS = tuple(
    ObjectPose(obj_id=i, instance=i, verdict="accepted", T_world_obj=se3.from_translation(t))
    for i, t in PLACES.items()
)


# A grasp from above in the middle of the book.
GRASP_OF_THE_BOOK = plain_grasps(
    se3.from_rt(np.diag([1.0, -1.0, -1.0]), [0, 0, 0.01])[None], obj_id=2, instance=2,
    widths_m=[0.11], scores=np.ones(1), base_scores=np.ones(1),
)  # fmt: skip
CONFIG = AnnotationConfig(plane_clearance_m=0.0, maps=("instance",))
INPUTS = FrameInputs(
    config=CONFIG, intrinsics=CAMERA, depth_unit_m=1e-4, objects=OBJECTS, models=MODELS,
    grasp_sets=(GRASP_OF_THE_BOOK,), digest="",
    surroundings=(PlacedMesh(BACKGROUND, table_slab(CONFIG), np.eye(4)),),
)  # fmt: skip


def camera_at(distance_m: float, azimuth: float = 0.7, up: float = 1.2) -> Array:
    eye = np.array([np.cos(azimuth), np.sin(azimuth), up])
    return se3.look_at(distance_m * eye / np.linalg.norm(eye), [0.0, 0.0, 0.03])


def rendered(T: Array, *things: PlacedMesh) -> Labels:
    return LabelRenderer([*INPUTS.placed(), *things]).render(CAMERA, T)


def annotated(T: Array, depth_m: Array32):
    """Return the objects' entries by name, and the visible masks by name."""
    frame = frame_files(INPUTS, FrameView(index=0, T_world_cam=T, digest=""), depth_m)
    entries = {e["name"]: e for e in frame.part["objects"]}

    def mask(number: int) -> Array:
        stored = np.frombuffer(frame.files[f"mask_visib/000000_{number:06d}.png"], np.uint8)
        return cv2.imdecode(stored, cv2.IMREAD_UNCHANGED) > 0

    return entries, {name: mask(e["mask"]) for name, e in entries.items()}


def hand(T: Array, over: list[float], size: tuple[float, float], before: float):
    """Return a slab before a point (3,) of the world, on its line of sight [m]."""
    x, y, z = se3.transform(se3.invert(T), np.array([over]))[0]
    near = (z - before) / z
    thing = se3.from_rt(se3.exp_so3([0.0, 0.0, 0.3]), [x * near, y * near, z * near])
    return PlacedMesh(-1, box((size[0], size[1], 0.02)), T @ thing)


@pytest.mark.parametrize(("azimuth", "up"), [(0.0, 0.15), (2.5, 3.0)])
def test_of_exact_depth_nothing_is_removed(azimuth: float, up: float) -> None:
    T = camera_at(0.5, azimuth, up)
    labels = rendered(T)
    entries, masks = annotated(T, labels.depth_m)
    for e in entries.values():
        assert e["unknown_occluder"]["finding"] == "none" and e["px_hidden_by_unknown"] == 0
        np.testing.assert_array_equal(masks[e["name"]], labels.ids == e["instance"])


@pytest.mark.parametrize(("over", "before"), [
    ([-0.07, 0.0, 0.1], 0.1), ([0.0, 0.0, 0.05], 0.2),
])  # fmt: skip
def test_a_hand_takes_exactly_its_pixels(over: list[float], before: float) -> None:
    T = camera_at(0.5)
    alone, held = rendered(T), rendered(T, hand(T, over, (0.05, 0.03), before))
    covered = (alone.ids >= 0) & (held.ids < 0)
    assert covered.sum() > 200
    entries, masks = annotated(T, held.depth_m)
    for e in entries.values():
        i = e["instance"]
        np.testing.assert_array_equal(masks[e["name"]], held.ids == i)
        hidden = int(np.count_nonzero(covered & (alone.ids == i)))
        assert e["px_hidden_by_unknown"] == hidden
        assert e["px_count_visib"] == np.count_nonzero(held.ids == i)
        assert e["visib_fract"] == pytest.approx(e["px_count_visib"] / e["px_count_all"])
        if hidden:
            assert e["unknown_occluder"]["gap_m"] > 0.02


def test_noise_is_not_taken_for_a_thing() -> None:
    removed = seen = 0
    for seed, azimuth in enumerate([0.0, 2.5]):
        T = camera_at(1.0, azimuth)
        labels = rendered(T)
        rng = np.random.default_rng(seed)
        measured = DepthSensorModel().measure(labels.depth_m, CAMERA, rng)
        entries, _ = annotated(T, measured)
        removed += sum(e["px_hidden_by_unknown"] for e in entries.values())
        seen += sum(labels.px_count_visib.values())
    assert removed < 1e-3 * seen


def test_speckle_and_fattened_edges_stay() -> None:
    T = camera_at(0.5)
    labels = rendered(T)
    rng = np.random.default_rng(0)
    measured = labels.depth_m.copy()
    measured[rng.random(measured.shape) < 0.03] *= 0.6
    measured[100:104, 60:260] *= 0.7  # a strip of 4 pixels
    entries, _ = annotated(T, measured)
    assert all(e["px_hidden_by_unknown"] == 0 for e in entries.values())
    fat = np.where(labels.depth_m > 0, labels.depth_m, np.float32(np.inf))
    fat = np.asarray(cv2.erode(fat, np.ones((7, 7), np.uint8)), np.float32)
    entries, _ = annotated(T, np.where(np.isfinite(fat), fat, 0).astype(np.float32))
    assert all(e["px_hidden_by_unknown"] == 0 for e in entries.values())


def test_a_wrong_pose_is_not_silently_taken_for_a_thing() -> None:
    T = camera_at(0.5)
    labels = rendered(T)
    nearer = np.where(labels.ids == 1, labels.depth_m - np.float32(0.03), labels.depth_m)
    entries, masks = annotated(T, nearer)
    mug = entries["mug"]
    assert mug["unknown_occluder"]["finding"] == "pose or occluder"
    assert not mug["unknown_occluder"]["is_removed"] and mug["px_hidden_by_unknown"] == 0
    np.testing.assert_array_equal(masks["mug"], labels.ids == 1)
    assert mug["unknown_occluder"]["gap_m"] == pytest.approx(0.03, abs=1e-3)
    assert entries["book"]["unknown_occluder"]["finding"] == "none"


def test_a_contact_behind_the_hand_is_not_seen() -> None:
    T = camera_at(0.5, up=3.0)
    free, _ = annotated(T, rendered(T).depth_m)
    assert free["book"]["grasps"] == {"hidden": 0, "partly": 0, "visible": 1}
    held = rendered(T, hand(T, PLACES[2], (0.13, 0.13), 0.15))
    behind, _ = annotated(T, held.depth_m)
    assert behind["book"]["grasps"] == {"hidden": 1, "partly": 0, "visible": 0}
