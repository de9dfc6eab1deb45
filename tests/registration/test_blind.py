"""Along what the depth cannot see a pose keeps its start's value; what it sees is corrected."""

from dataclasses import replace

import numpy as np
import pytest

from realsim.geometry import se3
from realsim.geometry.mesh import symmetry_transforms
from realsim.geometry.metrics import mssd
from realsim.geometry.parts import part
from realsim.records import ObjectPose
from realsim.registration.blind import twist_rad
from realsim.registration.register import register_scene
from table_scenes import QUICK

Z = np.array([0.0, 0.0, 1.0])
ROUND_PARTS = (
    ("cylinder_can", (-0.06, 0.05), 0.3, (0.0, 0.0, 0.0)),
    ("mug", (0.06, 0.05), 1.0, (0.0, 0.0, 0.0)),
)
CAN, MUG = 0, 1


def off(pose: ObjectPose, model, rng) -> ObjectPose:
    """The pose 10 mm and 10 deg off: 8 deg about the object's z, 6 deg across it."""
    across, v = rng.normal(size=3) * [1, 1, 0], rng.normal(size=3)
    tilt = np.radians(6) * across / np.linalg.norm(across)
    R = se3.exp_so3(tilt) @ se3.exp_so3(np.radians(8) * Z)
    C = se3.from_translation(model.mesh.bounds.mean(0))
    move = C @ se3.from_rt(R, 0.01 * v / np.linalg.norm(v)) @ se3.invert(C)
    return ObjectPose(
        obj_id=pose.obj_id, instance=pose.instance, T_world_obj=pose.T_world_obj @ move
    )


@pytest.fixture(scope="module")
def case(make_scene):
    """(scene, starts, registration); no model declares a symmetry."""
    scene = make_scene(ROUND_PARTS, 6, 4)
    plain = {
        k: replace(m, symmetries=np.eye(4)[None], symmetry_axes=()) for k, m in scene.models.items()
    }
    scene = replace(scene, models=plain)
    rng = np.random.default_rng(1)
    starts = [off(t, plain[t.obj_id], rng) for t in scene.truth]
    return scene, starts, registered(scene, scene.frames, starts)


def registered(scene, frames, starts):
    return register_scene("round", scene.intrinsics, frames, scene.models, starts, QUICK)


def error_mm(scene, instance: int, name: str, T) -> float:
    """MSSD over the part's full symmetry group, in steps that move no rim by 0.1 mm."""
    group = symmetry_transforms(part(name), 0.002)
    model = scene.models[scene.truth[instance].obj_id]
    return 1e3 * mssd(scene.truth[instance].T_world_obj, T, model.mesh.vertices, group)


def turn_deg(T_a, T_b) -> float:
    """Turn about the object's z from a to b."""
    return float(np.degrees(twist_rad(T_a[:3, :3].T @ T_b[:3, :3], Z)))


def test_a_can_keeps_its_turn_and_finds_its_place(case):
    scene, starts, result = case
    T = result.scene.object(CAN).T_world_obj
    assert abs(turn_deg(starts[CAN].T_world_obj, T)) < 0.5
    assert error_mm(scene, CAN, "cylinder_can", T) < 1.0
    assert result.scene.object(CAN).checks["blind_axes"] == 1
    assert result.scene.object(CAN).verdict == "accepted"
    blind = result.report["objects"][CAN]["blind"]
    assert blind["start_kept"]
    assert abs(blind["axes"][0]["axis_obj"][2]) > 0.999
    # The model declares nothing; its shape does.
    assert blind["axes"][0]["declared"]
    assert "body of revolution" in result.report["objects"][CAN]["symmetry"]


def test_a_handle_is_seen_and_its_turn_corrected(case):
    scene, starts, result = case
    T = result.scene.object(MUG).T_world_obj
    assert result.scene.object(MUG).checks["blind_axes"] == 0
    assert result.report["objects"][MUG]["blind"] == {}
    assert abs(turn_deg(starts[MUG].T_world_obj, T)) > 7
    assert abs(turn_deg(scene.truth[MUG].T_world_obj, T)) < 0.5
