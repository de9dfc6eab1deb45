"""Near-symmetric poses told apart: a shape with one small feature, turned the wrong way."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from realsim.geometry import se3
from realsim.geometry.mesh import merged, transformed
from realsim.geometry.parts import part
from realsim.records import Mesh, ObjectModel, ObjectPose, SupportPlane
from realsim.registration.body import make_body
from realsim.registration.evidence import DepthNoise
from realsim.registration.search.candidates import CandidateConfig, Sought, fuse
from realsim.registration.search.polish import ContrastConfig, Decision, decide_rivals
from realsim.registration.search.sameness import make_sameness
from realsim.registration.search.scoring import ScoreConfig, make_canvas
from realsim.registration.simulated import TableScene, resized, table_scene
from realsim.registration.views import SampleConfig, sample_views
from table_scenes import SMALL_LAB

NOISE = DepthNoise(per_m=0.08 / (648 * 0.018), floor_m=2e-4)
PLANE = SupportPlane(T_world_table=np.eye(4), rms_m=1e-3, inliers=1000)
CONFIG = ContrastConfig(lattice=ScoreConfig(columns=160, frames=10))
HALF_TURN = se3.from_rt(se3.exp_so3([0.0, 0.0, np.pi]), np.zeros(3))
QUARTER = se3.from_rt(se3.exp_so3([0.0, 0.0, np.pi / 2]), np.zeros(3))


def marked_box(knob_m: float) -> Mesh:
    """A block of 90 x 40 x 30 mm about the origin with a cube of this edge near one end."""
    box, cube = part("box").mesh, part("cube").mesh
    size = np.array([0.09, 0.04, 0.03])
    block = replace(box, vertices=(box.vertices - box.bounds.mean(0)) / box.extent * size)
    small = replace(cube, vertices=(cube.vertices - cube.bounds.mean(0)) / cube.extent * knob_m)
    top = se3.from_translation([0.035, 0.0, 0.015 + knob_m / 2 - 1e-4])
    return merged([block, transformed(small, top)])


@lru_cache(maxsize=4)
def scene(knob_m: float) -> tuple[TableScene, Sought]:
    model = ObjectModel(obj_id=1, name="marked box", mesh=marked_box(knob_m))
    pose = ObjectPose(
        obj_id=1, instance=0,
        T_world_obj=se3.from_rt(se3.exp_so3([0, 0, 0.4]), [0.01, -0.02, 0.015]),
    )  # fmt: skip
    lab = resized(replace(SMALL_LAB, views=10), 320)
    made = table_scene({1: model}, [pose], lab, np.random.default_rng(4))
    body = make_body(replace(pose, T_world_obj=np.eye(4)), model, 64, 100)
    return made, Sought(body=body, sameness=make_sameness(model))


def decide(knob_m: float, start: np.ndarray, near: np.ndarray) -> Decision:
    made, sought = scene(knob_m)
    views = sample_views(made.intrinsics, made.frames, NOISE, SampleConfig(stride=1))
    cloud = fuse(views, NOISE, PLANE, CandidateConfig()).fine
    canvas = make_canvas(made.intrinsics, made.frames, NOISE, PLANE, CONFIG.lattice)
    T = made.truth[0].T_world_obj @ start
    return decide_rivals(sought, T, canvas.table, (canvas, cloud, near), CONFIG, CandidateConfig())


def test_a_single_rival_that_is_right_replaces_a_wrong_pose():
    knob_m = 0.012
    made, sought = scene(knob_m)
    got = decide(knob_m, HALF_TURN, HALF_TURN[None])
    assert got.changed
    assert sought.sameness.distance(made.truth[0].T_world_obj, got.T_world_obj) < 0.003
    assert got.contrast is not None
    assert got.contrast > 0.1
    assert got.T_rival is not None


def test_the_right_pose_stays_and_its_rival_is_named():
    made, sought = scene(0.012)
    got = decide(0.012, np.eye(4), np.stack([HALF_TURN, QUARTER]))
    assert not got.changed
    assert sought.sameness.distance(made.truth[0].T_world_obj, got.T_world_obj) < 0.003
    assert got.contrast is not None
    assert got.contrast > 0.1
    assert got.T_rival is not None
    assert sought.sameness.distance(made.truth[0].T_world_obj, got.T_rival) > 0.01


def test_what_cannot_be_seen_is_undecided():
    """The knob is 0.3 mm: both ways round explain the images alike."""
    got = decide(0.0003, np.eye(4), HALF_TURN[None])
    assert got.contrast is not None
    assert got.contrast < 0.1


def test_a_fit_of_the_same_pose_that_ended_a_little_apart_is_no_rival():
    _, sought = scene(0.012)
    turn = se3.from_rt(se3.exp_so3([0.0, 0.0, np.radians(1.5)]), np.zeros(3))
    size = 2.0 * sought.body.radius_m
    assert sought.sameness.distance(np.eye(4), turn) < CONFIG.same_share * size
    assert decide(0.012, np.eye(4), turn[None]).contrast is None
