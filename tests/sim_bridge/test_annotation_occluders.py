"""Things that are not in the scene: found in the measured depth, and nothing else taken for one."""

import cv2
import numpy as np
import pytest

from plain_meshes import box
from realsim import CameraIntrinsics, GraspSet, ObjectModel, ObjectPose
from realsim.arrays import Array, Array32
from realsim.geometry import se3
from realsim.rendering.depth_sensors.model import DepthSensorModel
from realsim.rendering.labels import LabelRenderer, Labels, PlacedMesh
from realsim.rendering.rays import BACKGROUND
from realsim_sim_bridge.annotation.annotate import frame_files
from realsim_sim_bridge.annotation.config import AnnotationConfig
from realsim_sim_bridge.annotation.inputs import FrameInputs, FrameView, table_slab
from tried_grasps import plain_grasps

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


def grasps_of_the_book() -> GraspSet:
    """Return a grasp from above in the middle of the book."""
    T = se3.from_rt(np.diag([1.0, -1.0, -1.0]), [0, 0, 0.01])
    return plain_grasps(
        T[None], obj_id=2, instance=2, widths_m=[0.11], scores=np.ones(1), base_scores=np.ones(1)
    )


CONFIG = AnnotationConfig(plane_clearance_m=0.0, maps=("instance",))
INPUTS = FrameInputs(
    config=CONFIG, intrinsics=CAMERA, depth_unit_m=1e-4, objects=OBJECTS, models=MODELS,
    grasp_sets=(grasps_of_the_book(),), digest="",
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
