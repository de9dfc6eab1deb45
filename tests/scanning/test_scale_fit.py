"""The scale fit as a whole: laws that hold whatever the object, and known answers."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

import scanned_objects as lab
from realsim.arrays import Array
from realsim.errors import DegenerateError, InputError, RealsimError
from realsim.geometry import se3
from realsim.records import Mesh
from realsim.registration.refinement.equations import BIAS, HAND_EYE_AT
from realsim.scanning.scale.config import SampleConfig, ScaleConfig
from realsim.scanning.scale.joint import joint_fit
from realsim.scanning.scale.result import ScaleFit, Similarity
from realsim.scanning.scale.state import SIZE
from refusals import refused
from table_faults import without_any_depth


def z_of(fit: ScaleFit) -> float:
    return (fit.scale - lab.UNIT_M) / fit.sigma


def placed_vertices(fit: ScaleFit, mesh: Mesh) -> Array:
    return se3.transform(fit.T_world_obj, fit.scale * mesh.vertices)


@pytest.mark.slow
def test_without_errors_the_scale_is_right_to_a_tenth_of_a_per_cent():
    fit = lab.fitted("mug", "exact")
    assert fit.scale == pytest.approx(lab.UNIT_M, rel=1e-3)
    assert lab.surface_gap_mm(fit, lab.scanned("mug", "exact")) < 0.3
    assert fit.verdict == "accepted"
    assert abs(z_of(fit)) < 1.0


def test_with_a_labs_errors_scale_and_pose_are_as_good_as_the_result_says():
    fit, known = lab.fitted("bunny"), lab.scanned("bunny")
    assert fit.scale == pytest.approx(lab.UNIT_M, rel=0.005)
    assert fit.verdict == "accepted"
    assert lab.surface_gap_mm(fit, known) < 1.2
    low, high = fit.interval
    assert low < fit.scale < high
    np.testing.assert_allclose(fit.extent_mm, 1e3 * known.real.extent, rtol=0.005)


@pytest.mark.slow
def test_the_result_moves_with_the_world():
    known = lab.scanned("scalene")
    rng = np.random.default_rng(0)
    W = se3.from_rt(se3.random_rotation(rng), rng.uniform(-2, 2, 3))
    start = lab.rough_start(known)
    there = replace(start, T_world_obj=W @ start.T_world_obj)
    moved = lab.fit_of(known, frames=lab.in_world(known.frames, W), start=there)
    plain = lab.fitted("scalene")
    assert abs(moved.scale - plain.scale) < 0.25 * plain.sigma
    assert moved.sigma == pytest.approx(plain.sigma, rel=0.05)
    gap = placed_vertices(moved, known.scan) - se3.transform(W, placed_vertices(plain, known.scan))
    assert 1e3 * np.linalg.norm(gap, axis=1).max() < 0.15


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_meshs_unit_and_axes():
    known, unit = lab.scanned("bunny"), 25.4
    rng = np.random.default_rng(7)
    R, c = se3.random_rotation(rng), rng.uniform(-1, 1, 3)
    other = replace(known.scan, vertices=unit * (known.scan.vertices @ R.T + c))
    s = lab.rough_start(known)
    T = s.T_world_obj @ se3.invert(se3.from_rt(R, s.scale * (R @ (R.T @ c))))
    fit = lab.fit_of(known, other, start=Similarity(scale=s.scale / unit, T_world_obj=T))
    plain = lab.fitted("bunny")
    assert abs(unit * fit.scale - plain.scale) < 0.3 * plain.sigma
    assert unit * fit.sigma == pytest.approx(plain.sigma, rel=0.1)
    gap = placed_vertices(fit, other) - placed_vertices(plain, known.scan)
    # The bunny is its own mirror image, which is no turn: there is one pose.
    assert 1e3 * np.linalg.norm(gap, axis=1).max() < 0.3


@pytest.mark.slow
def test_order_and_numbers_of_the_frames_do_not_matter_and_progress_goes_to_the_end():
    known, plain = lab.scanned("bunny"), lab.fitted("bunny")
    order = np.random.default_rng(0).permutation(len(known.frames))
    frames = tuple(replace(known.frames[k], index=3 * known.frames[k].index + 2) for k in order)
    ticks: list[tuple[int, int]] = []
    fit = lab.fit_of(known, frames=frames, progress=lambda done, total: ticks.append((done, total)))
    assert fit.scale == plain.scale
    np.testing.assert_array_equal(fit.T_world_obj, plain.T_world_obj)
    assert [v.index for v in fit.views] == [3 * k + 2 for k in range(10)]
    assert ticks == [(k + 1, 14) for k in range(14)]


def test_a_start_and_none_lead_to_the_same():
    known = lab.scanned("bunny")
    given, found = lab.fitted("bunny"), lab.fit_of(known, start=None)
    assert abs(given.scale - found.scale) < 0.2 * given.sigma
    assert lab.surface_gap_mm(found, known) < 1.2
    assert found.verdict == "accepted"


@pytest.mark.slow
def test_intervals_hold_the_truth_over_many_seeds():
    z: list[float] = []
    for name in ("scalene", "bunny", "elbow"):
        for seed in range(4):
            known = lab.scanned(name, "lab", seed)
            mesh = lab.wrong(known.real, 0.02, seed) if seed % 2 else known.real
            z.append(z_of(lab.fit_of(known, lab.scaled(mesh, 1 / lab.UNIT_M))))
    assert np.mean(np.abs(z) < 1.96) > 0.8, np.round(z, 1)
    assert np.mean(np.abs(z) < 3.5) > 0.95, np.round(z, 1)


@pytest.mark.slow
def test_noise_of_the_depth_leaves_bias_and_hand_eye_alone():
    """Errors in variables, in the whole joint fit: exact cameras, white noise along every ray.

    The noise in its own derivative once moved both by 25 sigma, in every draw alike.
    """
    shape, evidence = lab.shape_of("bunny"), lab.evidence_of("bunny", "exact")
    state = lab.true_state(lab.scanned("bunny", "exact"), shape, evidence)
    config = ScaleConfig(samples=SampleConfig(noise_area_px=1.0))
    z: list[Array] = []
    for seed in range(3):
        rng = np.random.default_rng(seed)

        def noisy(points: Array, rng: np.random.Generator = rng) -> Array:
            z = points[:, 2]
            sigma = 0.0069 * np.square(z)
            return points * (1 + sigma * rng.standard_normal(len(z)) / z)[:, None]

        drawn = [(v, noisy(v.points), noisy(v.table)) for v in evidence.views]
        views = tuple(replace(v, points=points, table=table) for v, points, table in drawn)
        seen = replace(evidence, views=views, noise=replace(evidence.noise, per_m=0.0069))
        found, look = joint_fit(shape, seen, state, config)
        off = np.array([*found.hand_eye, found.bias[1], np.log(found.s / state.s)])
        z.append(off / np.sqrt(np.diag(look.covariance)[[*HAND_EYE_AT, BIAS.start + 1, SIZE]]))
    mean = np.mean(z, axis=0)
    # The priors hold what the points do not say: steps are smaller than the covariance, never
    # larger; half a sigma of a common mean is what cells and outlines may add.
    assert np.all(np.abs(mean) < 4 / np.sqrt(len(z)) + 0.5), mean.round(2)
    assert np.sqrt(np.mean(np.square(z))) < 1.5


def test_a_slipped_view_is_left_out_and_a_blind_one_named():
    known = lab.scanned("bunny")
    slip = se3.from_rt(se3.exp_so3([np.radians(2.0), 0, 0]), [0, 0.006, 0])
    frames = list(known.frames)
    frames[4] = replace(frames[4], T_world_cam=frames[4].T_world_cam @ slip)
    frames[6] = without_any_depth(frames[6])
    fit = lab.fit_of(known, frames=tuple(frames))
    assert [v.index for v in fit.views] == list(range(10))
    assert [v.index for v in fit.views if not v.used] == [4, 6]
    assert any("view 4" in n and "left out" in n for n in fit.notes)
    assert any("view 6 does not see the object" in n for n in fit.notes)
    assert abs(fit.scale - lab.fitted("bunny").scale) < 1.5 * fit.sigma
    assert fit.scale == pytest.approx(lab.UNIT_M, rel=0.005)
    for v in fit.views:
        if v.used:
            assert v.points > 50 and 0.9 < v.agree <= 1.0 and 0.85 < v.iou <= 1.0
            # The lab's errors are half a millimetre; a tenth of a degree turns about the hand.
            assert 0 < v.rms_mm < 5 and v.shift_mm < 2.0 and v.turn_deg < 0.4
        else:
            assert v.points == 0 and np.isnan(v.agree)


@pytest.mark.slow
def test_the_residual_map_shows_a_bump_with_sign_and_size():
    """The real block carries a plate on its top that the mesh does not know."""
    height_mm = 2.0
    # The knob tells top from bottom: with the plate hidden below, the depth would fit as well.
    knob = lab.shifted(lab.block((0.02, 0.03, 0.02)), -0.05, 0, -0.015)
    plain = lab.subdivided(lab.joined(lab.block((0.09, 0.06, 0.05)), knob), 5000)
    raised = plain.vertices.copy()
    plate = np.all(np.abs(raised[:, :2] - [0.02, 0.01]) < 0.015, axis=1) & (raised[:, 2] > 0.0249)
    raised[plate, 2] += height_mm / 1e3
    known = lab.scanned_mesh(Mesh(vertices=raised, faces=plain.faces), lab.LAB, seed=1)
    fit = lab.fit_of(known, lab.scaled(plain, 1 / lab.UNIT_M))
    v = plain.vertices
    on_plate = np.all(np.abs(v[:, :2] - [0.02, 0.01]) < 0.009, axis=1) & (v[:, 2] > 0.024)
    beside = (v[:, 0] < -0.01) & (v[:, 2] > 0.0249) & np.all(np.abs(v) < [0.04, 0.025, 1], axis=1)
    assert np.nanmedian(fit.residual_mm[on_plate]) == pytest.approx(height_mm, abs=0.6)
    assert abs(np.nanmedian(fit.residual_mm[beside])) < 0.5
    under = (v[:, 2] < -0.0249) & np.all(np.abs(v[:, :2]) < [0.035, 0.02], axis=1)
    assert np.all(np.isnan(fit.residual_mm[under]))
    assert len(fit.residual_mm) == len(v)
    assert fit.scale == pytest.approx(lab.UNIT_M, rel=0.02)


def test_limits_name_what_limits_worst_first():
    fit = lab.fitted("bunny")
    # The last one is not in the sigma.
    assert fit.limits[-1].name == "surface offset"
    percents = [limit.percent for limit in fit.limits[:-1]]
    assert percents == sorted(percents, reverse=True)
    names = {limit.name for limit in fit.limits}
    assert {"shape", "hand-eye", "arm", "depth noise", "surface offset"} <= names
    for limit in fit.limits[:-1]:
        assert 0 <= limit.percent <= 1.01 * fit.sigma_percent and limit.text


def test_covariance_candidates_and_history_tell_how_sure_it_is_and_how_it_was_found():
    fit = lab.fitted("bunny")
    gains = [c.score for c in fit.candidates]
    assert gains == sorted(gains, reverse=True)
    assert fit.candidates[0].scale == pytest.approx(fit.scale, rel=0.05)
    assert fit.history[-1]["scale"] == pytest.approx(fit.scale, rel=0.01)
    C = fit.covariance
    assert C.shape == (7, 7)
    np.testing.assert_allclose(C, C.T, atol=1e-12)
    assert np.linalg.eigvalsh(C).min() > 0
    assert np.sqrt(C[6, 6]) == pytest.approx(fit.sigma / fit.scale, rel=1e-6)


# --- What cannot be fitted is named with what to do, and no wrong scale is accepted.


def as_scan(name: str) -> Mesh:
    return lab.scaled(lab.real_mesh(name), 1 / lab.UNIT_M)


def test_several_objects():
    two = lab.joined(lab.shifted(lab.block(), -0.07, 0, 0), lab.shifted(lab.block(), 0.07, 0, 0))
    known = lab.scanned_mesh(two, replace(lab.LAB, views=6))
    with pytest.raises(InputError, match=r"2 objects .* x=.* mm tall.*--at x,y .*alone"):
        lab.fit_of(known, as_scan("block"), start=None)


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        (lambda f: (), "no depth frames"),
        (lambda f: f[:2], r"2 views .* at least 3 from different sides .* 12 or more"),
        (lambda f: [without_any_depth(g) for g in f], r"10 depth images .*Is the depth all zero\?"),
        (lambda f: [replace(g, depth_m=g.depth_m * np.float32(1000)) for g in f],
         r"(?i)millimet|unit|metres"),
        (lambda f: [replace(g, depth_m=(1e4 * g.depth_m).astype(np.uint16)) for g in f],
         r"uint16; float32 metres .* depth unit"),
        (lambda f: (*f[:3], replace(f[3], depth_m=f[3].depth_m[::2, ::2])),
         r"\(180, 320\); the camera's is \(360, 640\)"),
    ],
)  # fmt: skip
def test_frames_that_cannot_be_used_are_named(frames, said: str):
    known = lab.scanned("block")
    refused(said, lab.fit_of, known, error=RealsimError, frames=frames(known.frames))


def test_flat_meshes():
    known = lab.scanned("block")
    flat = replace(known.scan, vertices=known.scan.vertices * [1, 0, 0])
    said = refused(r"flat|line or a point", lab.fit_of, known, flat, error=DegenerateError)
    assert "extent" in said


@lru_cache(maxsize=16)
def another(real: str, given: str) -> ScaleFit:
    return lab.fit_of(lab.scanned(real), as_scan(given), start=None)


def test_a_mug_given_for_a_block_is_not_accepted():
    fit = another("block", "mug")
    assert fit.verdict != "accepted"
    assert "% of what was measured of the object" in " ".join(fit.reasons)
    assert all(len(r) > 20 for r in fit.reasons)


@pytest.mark.slow
@pytest.mark.parametrize(("real", "given"), [("l_bracket", "t_profile"), ("bunny", "duck")])
def test_no_mesh_of_another_object_is_accepted(real: str, given: str):
    assert another(real, given).verdict != "accepted"


@pytest.mark.slow
def test_a_mirrored_mesh_is_not_accepted_and_named():
    known = lab.scanned("scalene")
    fit = lab.fit_of(known, lab.mirrored(known.scan), start=None)
    assert fit.verdict != "accepted"
    assert any("mirror" in r for r in (*fit.reasons, *fit.notes))


@pytest.mark.slow
def test_an_open_mesh_is_fitted_too():
    """Scans have no underside: nobody saw it."""
    known = lab.scanned("bunny")
    mesh = known.scan
    middles = mesh.vertices[mesh.faces].mean(1)[:, 2]
    above = middles > mesh.vertices[:, 2].min() + 0.08 * mesh.extent[2]
    assert not above.all()
    fit = lab.fit_of(known, replace(mesh, faces=mesh.faces[above]))
    assert fit.scale == pytest.approx(lab.UNIT_M, rel=0.01)
    assert abs(fit.scale - lab.UNIT_M) < 3.5 * fit.sigma


@pytest.mark.slow
def test_poses_of_other_images_are_not_accepted():
    known = lab.scanned("bunny")
    exchanged = zip(known.frames, known.frames[3:] + known.frames[:3], strict=True)
    frames = tuple(replace(f, T_world_cam=other.T_world_cam) for f, other in exchanged)
    try:
        fit = lab.fit_of(known, frames=frames)
    except RealsimError as error:
        assert "pose" in str(error) or "stand" in str(error)
    else:
        assert fit.verdict != "accepted"
