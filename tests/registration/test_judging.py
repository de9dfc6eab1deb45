"""Residuals of surface patches: right poses leave none, near-symmetric ones leave much."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from realsim.errors import UnitError
from realsim.geometry import se3
from realsim.records import SupportPlane
from realsim.registration.body import moved_body
from realsim.registration.compare import make_comparer
from realsim.registration.evidence import average_cloud
from realsim.registration.judging.held_out import box_shift_m, held_out, owned_points
from realsim.registration.judging.scene_checks import scene_findings, unit_errors
from realsim.registration.judging.surface_residuals import (
    LEVEL_M,
    WRONG_M,
    error_level_m,
    residual_checks,
    surface_residuals,
    wrong_bound_m,
)
from realsim.registration.judging.verdict import (
    CONTRAST_DECIDED,
    HELD_OUT,
    SURFACE,
    probability_right,
    verdict_of,
)
from realsim.registration.table_planes import support_checks
from realsim.registration.views import world_cloud
from table_scenes import NOISE, TABLE, bodies_of, named_scene, true_cameras, true_poses, views_of


@pytest.fixture(scope="module")
def watched():
    """(scene, bodies, true poses, a function poses -> residuals) with true cameras."""
    scene = named_scene(3, ("gear", "box", "mug", "t_profile"), 16)
    bodies, views = bodies_of(scene, 64, 300), views_of(scene)

    def residuals(poses, Ts=scene.Ts_world_cam, plane=TABLE):
        return surface_residuals(bodies, poses, scene.intrinsics, views, Ts, NOISE, plane)

    return scene, bodies, true_poses(scene), residuals


def checks_of(results):
    return [residual_checks(r, error_level_m(results)) for r in results]


def test_true_poses_leave_no_wrong_surface(watched):
    _, _, poses, residuals = watched
    for c in checks_of(residuals(poses)):
        assert c["wrong_surface"] < 0.02
        assert c["looked_through"] < 0.02
        assert c["patch_rms"] < 0.3
        assert c["measured_surface"] > 0.3


def test_a_gear_turned_by_half_a_tooth_leaves_much(watched):
    _, bodies, poses, residuals = watched
    order = len(bodies[0].model.symmetries) // 2
    C = se3.from_translation(bodies[0].center_obj)
    turned = poses[0] @ C @ se3.exp([0, 0, np.pi / order, 0, 0, 0]) @ se3.invert(C)
    first, *others = checks_of(residuals([turned, *poses[1:]]))
    assert first["wrong_surface"] > 0.1
    assert first["wrong_patch_mm2"] > 100
    assert all(c["wrong_surface"] < 0.02 for c in others)


@pytest.mark.parametrize("millimetres", [-0.4, 0.3, 2.0])
def test_a_shift_up_is_measured_with_its_sign(watched, millimetres):
    _, _, poses, residuals = watched
    up = se3.from_translation([0, 0, 1e-3 * millimetres])
    r = residuals([poses[0], up @ poses[1], *poses[2:]])[1]
    # Patches that face up: the real surface lies below a model that was moved up.
    facing = (r.patches.normals @ poses[1][:3, :3].T)[:, 2] > 0.95
    before = residuals(poses)[1].mean_m[facing]
    assert np.nanmedian(r.mean_m[facing] - before) == pytest.approx(-1e-3 * millimetres, abs=1e-4)


def test_the_world_may_be_turned(watched):
    scene, _, poses, residuals = watched
    G = se3.exp([0.3, -0.5, 1.2, 0.4, -0.2, 0.7])
    moved = residuals([G @ T for T in poses], G @ scene.Ts_world_cam, SupportPlane(T_world_table=G))
    for a, b in zip(residuals(poses), moved, strict=True):
        both = a.measured & b.measured
        assert np.mean(a.measured == b.measured) > 0.99
        np.testing.assert_allclose(np.median(a.mean_m[both] - b.mean_m[both]), 0, atol=1e-7)


def test_free_space_is_looked_through_where_nothing_stands(watched):
    _, _, poses, residuals = watched
    lifted = se3.from_translation([0, 0, 0.06]) @ poses[1]
    assert checks_of(residuals([poses[0], lifted, *poses[2:]]))[1]["looked_through"] > 0.5


def test_errors_that_all_objects_share_raise_the_bound_but_not_without_end(watched):
    scene, _, poses, residuals = watched
    exact = error_level_m(residuals(poses))
    # Cameras 1.2 mm too near along their axes: depth bias of a cheap camera.
    results = residuals(poses, scene.Ts_world_cam @ se3.from_translation([0, 0, 0.0012]))
    level = error_level_m(results)
    assert exact < 0.0004 < level <= LEVEL_M[1]
    assert wrong_bound_m(exact) == WRONG_M
    shares = [c["wrong_surface"] for c in checks_of(results)]
    without = [residual_checks(r, exact)["wrong_surface"] for r in results]
    assert max(shares) < 0.1 < min(without)
    # A single object cannot excuse itself.
    assert error_level_m(results[:1]) < level


# --- Held-out views: halves of the views find a right pose again and pull a wrong one apart.


@pytest.fixture(scope="module")
def halved():
    """(bodies, true poses, a function poses -> HeldOut of each)."""
    scene = named_scene(5, ("wedge", "box", "mug"), 12)
    bodies, views = bodies_of(scene, 64, 300), views_of(scene)

    def judge(poses):
        seen = (scene.intrinsics, views, scene.Ts_world_cam)
        return held_out(bodies, poses, owned_points(bodies, poses, *seen, NOISE, TABLE), len(views))

    return bodies, true_poses(scene), judge


def test_both_halves_find_a_right_pose(halved):
    bodies, poses, judge = halved
    for body, T, h in zip(bodies, poses, judge(poses), strict=True):
        assert h.shift_mm < 1.0
        assert h.agree > 0.97
        assert 1e3 * box_shift_m(body, T, h.Ts_world_obj[0]) < 1.0


def test_a_wrong_place_shows_on_unused_views(halved):
    _, poses, judge = halved
    right = judge(poses)[1]
    slid = se3.from_translation([0.02, 0.015, 0.01]) @ poses[1]
    wrong = judge([poses[0], slid, poses[2]])[1]
    assert not wrong.shift_mm < right.shift_mm or not wrong.agree >= right.agree


# --- What is wrong with a whole scene: shifted, sunk, swapped, absent, in other units.


@pytest.fixture(scope="module")
def table():
    """(scene, bodies at the truth, true poses, a function of bodies and poses -> findings)."""
    scene = true_cameras(named_scene(7, ("box", "wedge", "mug", "u_channel"), 8))
    comparer = make_comparer(scene.intrinsics, scene.frames, NOISE, TABLE)
    cloud = average_cloud(world_cloud(views_of(scene, stride=2), NOISE), np.eye(4), 0.003)
    cloud = cloud.select(cloud.points[:, 2] > 0.003)

    def findings(bodies, poses, probabilities=(0.99,) * 4, with_starts=True):
        return scene_findings(bodies, poses, probabilities, cloud, comparer, with_starts)

    return scene, bodies_of(scene, 48, 300), true_poses(scene), findings


def test_a_right_scene_has_no_findings(table):
    _, bodies, poses, findings = table
    assert findings(bodies, poses) == []


def test_a_common_shift_of_the_starts_is_named(table):
    _, bodies, poses, findings = table
    shift = se3.from_translation([0.02, -0.01, 0.0])
    moved = [moved_body(b, shift @ b.T_start) for b in bodies]
    (found,) = findings(moved, poses)
    assert found.kind == "common shift"
    assert "22.4 mm" in found.words
    assert found.instances == tuple(b.start.instance for b in bodies)
    assert findings(moved, poses, with_starts=False) == []


def test_sinking_alike_is_named(table):
    _, bodies, _, findings = table
    sunk = []
    for b in bodies:
        height = np.ptp(se3.transform(b.T_start, b.model.mesh.vertices)[:, 2])
        sunk.append(se3.from_translation([0, 0, -0.05 * height]) @ b.T_start)
    (found,) = findings(bodies, sunk, with_starts=False)
    assert found.kind == "common sinking"
    assert "5.0 %" in found.words
    assert "too large" in found.words


def test_swapped_ids_are_named(table):
    _, bodies, true, findings = table
    names = [b.model.name for b in bodies]
    a, b = names.index("wedge"), names.index("u_channel")
    # Where the other one is, in whatever turn: as a registration of swapped ids ends.
    poses = [*true]
    for here, there in ((a, b), (b, a)):
        away = bodies[there].center(true[there]) - bodies[here].center(true[here])
        poses[here] = se3.from_translation(away) @ true[here]
    told = findings(bodies, poses, [0.01 if k in (a, b) else 0.99 for k in range(4)])
    (found,) = (f for f in told if f.kind == "swapped ids")
    assert set(found.instances) == {bodies[a].start.instance, bodies[b].start.instance}
    assert names[a] in found.words


def test_a_model_that_is_not_there_is_named(table):
    _, bodies, (a, b, c, d), findings = table
    away = se3.from_translation([0.3, 0.0, 0.0]) @ c
    (found,) = findings(bodies, [a, b, away, d], [0.99, 0.99, 0.001, 0.99])
    assert found.kind == "not in the scene"
    assert "mug" in found.words


@pytest.mark.parametrize("factor", [1000.0, 0.001])
def test_a_mesh_in_the_wrong_unit_is_an_error_with_the_number(table, factor):
    scene, bodies, _, _ = table
    model = bodies[0].model
    mesh = replace(model.mesh, vertices=factor * model.mesh.vertices)
    models = {**scene.models, model.obj_id: replace(model, mesh=mesh)}
    errors = unit_errors(models, scene.truth, scene.Ts_world_cam[:, :3, 3], 0.35)
    assert set(errors) == {bodies[0].start.instance}
    (error,) = errors.values()
    assert isinstance(error, UnitError)
    assert f"{np.linalg.norm(mesh.extent):.4g}" in str(error)
    assert "mixed up" in str(error)


def test_a_start_in_millimetres_is_an_error_and_right_ones_are_none(table):
    scene, bodies, _, _ = table
    cameras = scene.Ts_world_cam[:, :3, 3]
    assert unit_errors(scene.models, scene.truth, cameras, 0.35) == {}
    T = bodies[1].T_start.copy()
    T[:3, 3] = [120.0, -80.0, 30.0]
    start = replace(bodies[1].start, instance=9, T_world_obj=T)
    errors = unit_errors(scene.models, [*scene.truth, start], cameras, 0.35)
    assert set(errors) == {9}
    assert "120" in str(errors[9])
    assert "millimetres" in str(errors[9])


def test_floating_and_sinking_are_lengths_and_a_stack_does_not_float(table):
    _, bodies, poses, _ = table
    checks = support_checks(bodies, poses, TABLE)
    assert all(c["sunk_mm"] < 1e-6 and c["floating_mm"] < 1e-6 for c in checks)
    lifted = [se3.from_translation([0, 0, 0.005]) @ poses[0], *poses[1:]]
    assert support_checks(bodies, lifted, TABLE)[0]["floating_mm"] == pytest.approx(5.0, abs=2.0)
    sunk = [se3.from_translation([0, 0, -0.004]) @ poses[0], *poses[1:]]
    assert support_checks(bodies, sunk, TABLE)[0]["sunk_mm"] == pytest.approx(4.0, abs=1e-6)
    top = se3.transform(poses[0], bodies[0].model.mesh.vertices)[:, 2].max()
    shift = bodies[0].center(poses[0]) - bodies[1].center(poses[1])
    stacked = se3.from_translation([shift[0], shift[1], top]) @ poses[1]
    piled = support_checks(bodies, [poses[0], stacked, *poses[2:]], TABLE)[1]
    assert piled["floating_mm"] < 6.0 < 1e3 * top
    assert support_checks(bodies, poses, None) == [{}] * 4


# --- The probability that a pose is right: monotone, careful with gaps; verdicts in words.

CHECKS = {
    "agree": (0.995, 0.5),
    "gain": (0.94, 0.1),
    "cover": (0.995, 0.5),
    "free_space_violation": (0.003, 0.4),
    "hidden": (0.01, 0.4),
    "n_pixels": (40_000.0, 500.0),
    "residual_median_mm": (0.33, 2.5),
    "penetration_mm": (0.2, 15.0),
    "sunk_mm": (0.1, 10.0),
    "floating_mm": (0.0, 15.0),
    "wrong_surface": (0.001, 0.5),
    "patch_rms": (0.1, 2.5),
    "wrong_patch_mm2": (5.0, 1500.0),
    "looked_through": (0.002, 0.4),
    "residual_bound_mm": (1.0, None),
    "held_out_shift_mm": (0.4, 8.0),
    "held_out_agree": (0.99, 0.7),
}
"""What a right pose leaves and what a wrong one does; a bound of the scene is the same for both."""
GOOD = {name: good for name, (good, _) in CHECKS.items()}
BAD = {name: bad for name, (_, bad) in CHECKS.items() if bad is not None}


def without(names):
    return {k: v for k, v in GOOD.items() if k not in names}


KEPT = (GOOD, without(HELD_OUT), without((*HELD_OUT, *SURFACE)))
"""All checks, and those that are left where others could not be made."""


def test_good_checks_are_believed_and_bad_ones_are_not():
    for kept, least in zip(KEPT, (0.97, 0.95, 0.8), strict=True):
        assert probability_right(kept) > least
        assert probability_right({k: BAD.get(k, v) for k, v in kept.items()}) < 0.01


def test_more_evidence_never_lowers_it():
    for name, kept in product(sorted(BAD), KEPT):
        told = [
            probability_right({**kept, name: (1 - t) * BAD[name] + t * GOOD[name]})
            for t in np.linspace(0, 1, 15)
            if name in kept
        ]
        assert np.all(np.diff(told) >= 0)


def test_what_was_not_seen_is_not_right_and_no_table_is_no_reproach():
    assert probability_right({**GOOD, "n_pixels": 0.0}) == 0.0
    assert probability_right({**GOOD, "agree": float("nan")}) == 0.0
    assert probability_right({}) == 0.0
    assert probability_right(without(("sunk_mm", "floating_mm"))) > 0.95


def test_an_undecided_rival_makes_it_doubtful():
    decided = probability_right({**GOOD, "contrast": 2 * CONTRAST_DECIDED})
    assert decided == probability_right({**GOOD, "contrast": None}) == probability_right(GOOD)
    assert probability_right({**GOOD, "contrast": 0.0}) < decided
    verdict, reasons = verdict_of(0.99, {**GOOD, "contrast": 0.02})
    assert verdict == "doubtful"
    assert any("0.02" in r and "symmetric" in r for r in reasons)


def test_verdicts_have_reasons_with_numbers_in_words():
    assert verdict_of(0.99, GOOD) == ("accepted", ())
    verdict, reasons = verdict_of(0.5, {**GOOD, "wrong_surface": 0.12})
    assert verdict == "doubtful"
    assert "0.12 of its seen surface is more than 1.0 mm off" in reasons
    verdict, reasons = verdict_of(0.001, {**GOOD, **BAD})
    assert verdict == "rejected"
    assert len(reasons) > 8
    assert all(any(ch.isdigit() for ch in r) for r in reasons)


def test_what_is_deep_inside_another_object_is_never_accepted():
    verdict, reasons = verdict_of(0.99, {**GOOD, "penetration_mm": 29.5})
    assert verdict == "doubtful"
    assert "29.50 mm inside another object" in reasons
    assert verdict_of(0.99, {**GOOD, "penetration_mm": 3.0})[0] == "accepted"
