"""Laws of capture plans: exactly n views, every pose and every move as promised."""

from dataclasses import replace
from itertools import pairwise, permutations, product

import numpy as np
import pytest

from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.robots.arm import UR5, find_arm
from realsim_capture_plans.collision.model import CollisionModel, interpolate
from realsim_capture_plans.collision.mount import d405_mount
from realsim_capture_plans.planning.advise import advice, advise
from realsim_capture_plans.planning.elbow import elbow_of, raised, reach_m
from realsim_capture_plans.planning.make import calibration_plan, hemisphere_plan
from realsim_capture_plans.planning.moves import detour
from realsim_capture_plans.planning.ordering import Clusters, move_seconds, tour, tour_seconds
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig
from realsim_capture_plans.planning.tour_search import held_karp_bound, two_nearest_bound
from realsim_capture_plans.planning.view_quality import hole_deg
from realsim_capture_plans.planning.viewpoints import golden_cap, hemisphere_poses, reachable
from refusals import refused

CENTER = np.array([0.375, 0.0, 0.05])
BOARD = np.array([0.375, 0.0, 0.0])
N = 16


@pytest.fixture(scope="module")
def scene_plan() -> CapturePlan:
    return hemisphere_plan(N, CENTER, d405_mount(), PlanConfig(), np.random.default_rng(1))


@pytest.fixture(scope="module")
def board_plan() -> CapturePlan:
    return calibration_plan(N, BOARD, d405_mount(), PlanConfig(), np.random.default_rng(1))


@pytest.fixture(scope="module")
def panda_plan() -> CapturePlan:
    """By an arm of seven joints, of which every pose leaves one free."""
    config = PlanConfig(least_directions=40, elevation_deg=(40.0, 90.0), closer_rounds=2)
    arm = find_arm("panda").chain
    return hemisphere_plan(8, CENTER, d405_mount(), config, np.random.default_rng(1), chain=arm)


@pytest.fixture(params=["scene_plan", "board_plan", "panda_plan"])
def plan(request: pytest.FixtureRequest) -> CapturePlan:
    return request.getfixturevalue(request.param)


def test_exactly_n_poses_that_follow_from_the_joints(plan: CapturePlan) -> None:
    arm = plan.chain
    assert len(plan) == (N if arm is UR5 else 8) and plan.joints.shape[1] == arm.joints
    assert np.abs(arm.forward(plan.joints) - plan.Ts_base_ee).max() < 1e-9
    assert np.abs(plan.Ts_base_ee @ plan.mount.T_ee_cam - plan.Ts_base_cam).max() < 1e-12
    assert np.all(arm.limits.contains(plan.joints))
    assert np.all(arm.sigma_min(plan.joints) >= plan.config.sigma_min)


def test_every_move_keeps_the_clearance_on_a_finer_grid_than_planned(plan: CapturePlan) -> None:
    model = plan.collision_model()
    for k in range(len(plan)):
        corners = plan.move(k)
        samples, _ = interpolate(corners[:-1], corners[1:], plan.config.edge_step_rad / 2)
        least = min(d.min() for d in model.clearance(samples).values())
        # Between checked configurations a link moves a few millimetres at most.
        assert least > plan.config.clearance_m - 0.004


def test_moves_join_up_and_metrics_are_theirs(plan: CapturePlan) -> None:
    corners = [plan.move(k) for k in range(len(plan))]
    assert np.array_equal(corners[0][0], plan.home)
    for before, after in pairwise(corners):
        assert np.array_equal(before[-1], after[0])
    legs = np.concatenate([np.abs(np.diff(c, axis=0)) for c in corners])
    assert plan.metrics["travel_total_rad"] == pytest.approx(legs.sum())
    seconds = move_seconds(legs.max(1), plan.config.speed, plan.config.acceleration).sum()
    assert plan.metrics["seconds"] == pytest.approx(seconds)
    assert plan.metrics["colliding_legs"] == 0


def test_scene_views_look_at_the_centre_from_the_allowed_shell(scene_plan: CapturePlan) -> None:
    p = scene_plan
    centre_cam = np.stack([se3.transform(se3.invert(T), CENTER[None])[0] for T in p.Ts_base_cam])
    assert np.abs(centre_cam[:, :2]).max() < 1e-9
    low, high = p.config.radius_m
    assert centre_cam[:, 2].min() > low - 1e-9 and centre_cam[:, 2].max() < high + 1e-9
    elevation = np.degrees(np.arcsin(p.directions()[:, 2]))
    assert elevation.min() > p.config.elevation_deg[0] - 1e-6
    assert elevation.max() < p.config.elevation_deg[1] + 1e-6
    assert p.reference_view == np.argmax(p.directions()[:, 2])


def test_scene_views_cover_the_cap_nearly_as_well_as_an_ideal_spiral(
    scene_plan: CapturePlan,
) -> None:
    ideal = hole_deg(golden_cap(N, scene_plan.config.elevation_deg), (15.0, 90.0))
    assert scene_plan.metrics["hole_deg"] < 1.35 * ideal


def test_board_views_roll_all_round_and_vary_tilt_and_distance(board_plan: CapturePlan) -> None:
    m = board_plan.metrics
    # One view per 15 degrees of roll: neighbours are at most two sectors apart.
    assert m["roll_gap_deg"] < 2 * 360 / N + 1e-9
    assert m["tilt_max_deg"] <= board_plan.config.board_tilt_deg + 1e-6
    assert m["tilt_max_deg"] - m["tilt_min_deg"] > 25
    low, high = board_plan.config.board_distance_m
    assert low - 1e-9 <= m["distance_min_m"] < low + 0.06
    assert high - 0.06 < m["distance_max_m"] <= high + 1e-9
    # The optical axes meet the board inside the square of aim points, spread over it.
    T = board_plan.Ts_base_cam
    s = (BOARD[2] - T[:, 2, 3]) / T[:, 2, 2]
    aim = T[:, :3, 3] + s[:, None] * T[:, :3, 2] - BOARD
    assert np.abs(aim).max() <= np.sqrt(2) * board_plan.config.aim_jitter_m + 1e-9
    assert np.ptp(aim[:, :2], axis=0).min() > board_plan.config.aim_jitter_m


def test_the_same_seed_gives_the_same_plan() -> None:
    def make(seed: int) -> CapturePlan:
        return calibration_plan(4, BOARD, d405_mount(), PlanConfig(), np.random.default_rng(seed))

    assert make(4).content_hash == make(4).content_hash


def test_the_plan_turns_with_the_scene() -> None:
    """Turning the scene about the base's axis turns the first joint: as many views are reached."""
    counts = []
    for angle in (0.0, 0.7):
        c, s = np.cos(angle), np.sin(angle)
        center = [0.375 * c, 0.375 * s, 0.05]
        config = PlanConfig(table_rectangle_m=(-2.0, 2.0, -2.0, 2.0), keep_out_m=(0.01, 0.01, 0.05))
        turned = golden_cap(60, (15.0, 90.0)) @ se3.exp_so3([0.0, 0.0, angle]).T
        poses, item = hemisphere_poses(center, turned, config.radius_m, 6, 0.0)
        cell = config.work_cell(center, "hemisphere")
        model = CollisionModel(UR5, d405_mount(), cell, config.clearance_m)
        found = reachable(poses, item, d405_mount().T_ee_cam, model, config.sigma_min)
        counts.append(len(found.joints))
    assert counts[0] == pytest.approx(counts[1], rel=0.01)


def test_advice_prefers_the_places_that_reach_most() -> None:
    far = {"distances_m": (0.4, 0.6), "lifts_m": (0.0,)}
    places = advise(UR5, d405_mount(), PlanConfig(), 8, 0.05, **far)
    assert [p.center[0] for p in places] == [0.4, 0.6]
    assert places[0].reachable_share > places[1].reachable_share
    assert places[0].one_elbow_hole_deg < places[1].one_elbow_hole_deg
    text = advice(places, [0.0, 0.6, 0.05], 0.0)
    assert "0.40 m from the base" in text and "now (0.60 m)" in text


def test_too_few_reachable_views_say_how_many_and_what_to_do() -> None:
    # A small arm is told nearer places and radii that it reaches.
    says = r"only \d+ are reachable.*for a UR3e .*--center 0\.[23]\d*,0,0\.05"
    rng, small = np.random.default_rng(0), find_arm("ur3e").chain
    with pytest.raises(DegenerateError, match=says):
        hemisphere_plan(24, [1.25, 0.4, 0.05], d405_mount(), PlanConfig(), rng, chain=small)
    refused("millimetres", PlanConfig, radius_m=(280.0, 420.0))


def test_a_detour_is_found_round_the_keep_out_box(scene_plan: CapturePlan) -> None:
    # A box as high as the nearest views: straight moves across it collide.
    config = replace(scene_plan.config, keep_out_m=(0.16, 0.16, 0.26))
    cell = config.work_cell(CENTER, "hemisphere")
    model = CollisionModel(UR5, d405_mount(), cell, config.clearance_m)
    q = scene_plan.joints[model.free(scene_plan.joints)]
    a, b = np.triu_indices(len(q), 1)
    blocked = np.flatnonzero(~model.edges_free(q[a], q[b], config.edge_step_rad))
    assert len(blocked) > 0
    first, last = q[a[blocked[0]]], q[b[blocked[0]]]
    via = detour(first, last, scene_plan.home, model, config, np.random.default_rng(2))
    corners = np.concatenate([first[None], via, last[None]])
    assert np.all(model.edges_free(corners[:-1], corners[1:], config.edge_step_rad))
    again = detour(first, last, scene_plan.home, model, config, np.random.default_rng(2))
    assert np.array_equal(via, again)


@pytest.mark.parametrize(
    ("name", "elbow", "stretched"),
    [("ur5", 2, 0.0), ("ur10e", 2, 0.0), ("iiwa14", 3, 0.0), ("panda", 3, -0.467)],
)
def test_an_elbow_is_found_where_the_arm_is_longest(
    name: str, elbow: int, stretched: float
) -> None:
    chain = find_arm(name).chain
    found = elbow_of(chain)
    assert found is not None and found[0] == elbow
    assert found[1] == pytest.approx(stretched, abs=1e-3)
    q = np.random.default_rng(0).uniform(-1, 1, (20, chain.joints))

    def lengths(q: np.ndarray) -> np.ndarray:
        frames = chain.link_frames(q)[..., :3, 3]
        return np.linalg.norm(frames[:, -3] - frames[:, 1], axis=-1)

    q[:, elbow] = stretched
    longest, tall = lengths(q), raised(chain, q)
    assert np.allclose(longest, reach_m(chain), atol=1e-6)
    for step in (-0.05, 0.05):
        other, lower = q.copy(), tall.copy()
        other[:, elbow] += step
        lower[:, 1] += step
        assert np.all(lengths(other) < longest)
        height, most = (chain.link_frames(p)[:, -3, 2, 3] for p in (lower, tall))
        assert np.all(height < most + 1e-9)


@pytest.mark.slow
def test_128_views_where_advice_puts_them() -> None:
    center = [0.40, 0.0, 0.05]
    plan = hemisphere_plan(128, center, d405_mount(), PlanConfig(), np.random.default_rng(0))
    assert len(plan) == 128
    assert plan.metrics["colliding_legs"] == 0
    # Holes shrink with the root of the number of views: of 256 they are 6 and 8 degrees.
    assert plan.metrics["hole_reachable_deg"] < 6.0 * np.sqrt(2)
    assert plan.metrics["hole_cap_deg"] < 8.0 * np.sqrt(2)
    assert plan.metrics["tour_over_bound"] < 1.2


# --- The tour: every view once, never longer than before, never shorter than the bounds.

CONFIG = PlanConfig()
PACE = CONFIG.speed, CONFIG.acceleration
HOME = np.zeros(6)


def random_clusters(views: int, candidates: int, seed: int) -> Clusters:
    rng = np.random.default_rng(seed)
    stops = [rng.normal(size=(1 + rng.integers(candidates), 6)) for _ in range(views)]
    return Clusters.of(stops, HOME, CONFIG)


def shortest(clusters: Clusters) -> float:
    """Time of the best tour, by trying all of them."""
    n = len(clusters)
    rows = [range(a, b) for a, b in zip(clusters.first[1:-1], clusters.first[2:], strict=True)]
    best = np.inf
    for order in permutations(range(n)):
        for path in product(*(rows[i] for i in order)):
            best = min(best, tour_seconds(clusters, np.array(path), CONFIG))
    return best


def test_small_tours_are_the_shortest_there_are_and_bounds_hold() -> None:
    clusters = random_clusters(5, 3, 1)
    path = tour(clusters, CONFIG, np.random.default_rng(0), steps=300)
    best = shortest(clusters)
    assert tour_seconds(clusters, path, CONFIG) == pytest.approx(best)
    assert two_nearest_bound(clusters.least_s) <= best + 1e-9
    bound = held_karp_bound(clusters.least_s, best)
    assert two_nearest_bound(clusters.least_s) - 1e-9 <= bound <= best + 1e-9


def test_a_tour_visits_every_view_once_and_more_steps_never_lengthen_it() -> None:
    clusters = random_clusters(40, 8, 0)
    first = tour(clusters, CONFIG, np.random.default_rng(1), steps=0)
    longer = tour(clusters, CONFIG, np.random.default_rng(1), steps=400)
    for path in (first, longer):
        assert sorted(clusters.stop(row)[0] for row in path) == list(range(40))
        assert all(clusters.row(clusters.stop(row)) == row for row in path.tolist())
    again = tour(clusters, CONFIG, np.random.default_rng(1), steps=50, start=longer)
    seconds = [tour_seconds(clusters, p, CONFIG) for p in (first, longer, again)]
    assert seconds[0] > seconds[1] >= seconds[2] - 1e-9
    bound = held_karp_bound(clusters.least_s, seconds[2])
    assert two_nearest_bound(clusters.least_s) <= bound <= seconds[2]


def test_the_tour_of_points_on_a_line_is_the_line() -> None:
    place = np.random.default_rng(0).permutation(12)
    stops = [np.array([[0.1 * p, 0, 0, 0, 0, 0], [9.0, 9, 9, 9, 9, 9]]) for p in place]
    home = np.array([-0.1, 0, 0, 0, 0, 0])
    clusters = Clusters.of(stops, home, CONFIG)
    path = tour(clusters, CONFIG, np.random.default_rng(0), steps=200)
    visited = [clusters.stop(row) for row in path.tolist()]
    assert [place[view] for view, _ in visited] == list(range(12))
    assert all(candidate == 0 for _, candidate in visited)
    # Without the far candidates, in which all views are one, a line is its own bound.
    alone = Clusters.of([q[:1] for q in stops], home, CONFIG)
    seconds = tour_seconds(clusters, path, CONFIG)
    assert held_karp_bound(alone.least_s, seconds) == pytest.approx(seconds, rel=1e-3)


def test_colliding_moves_are_gone_round() -> None:
    clusters = random_clusters(12, 4, 5)
    free = tour(clusters, CONFIG, np.random.default_rng(0), steps=200)
    rows = [0, *free.tolist()]
    bad = {(rows[3], rows[4]), (rows[4], rows[3]), (rows[7], rows[8]), (rows[8], rows[7])}
    path = tour(clusters, CONFIG, np.random.default_rng(0), steps=300, colliding=bad)
    assert not set(zip([0, *path[:-1].tolist()], path.tolist(), strict=True)) & bad
    plain = tour_seconds(clusters, free, CONFIG)
    assert tour_seconds(clusters, free, CONFIG, bad) == pytest.approx(plain + 2 * 5.0)
    assert plain <= tour_seconds(clusters, path, CONFIG) < plain + 5.0


def test_move_times_are_continuous_and_trapezoidal() -> None:
    knee = CONFIG.speed**2 / CONFIG.acceleration
    just_below = float(move_seconds(knee * (1 - 1e-9), *PACE))
    assert move_seconds(knee, *PACE) == pytest.approx(just_below)
    assert move_seconds(2.0, *PACE) == pytest.approx(2.0 / 1.05 + 1.05 / 1.4)
    assert move_seconds(0.0, *PACE) == 0.0
