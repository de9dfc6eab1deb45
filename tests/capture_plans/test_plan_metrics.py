"""Metrics of a plan: laws (turning, slowing down), then answers worked out by hand."""

import base64
import re
import sys
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from given_plans import plan_through
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.robots.arm import UR5
from realsim.robots.shapes import Box, WorkCell
from realsim_capture_plans.collision.mount import d405_mount
from realsim_capture_plans.pictures.drawing import PlanCurves
from realsim_capture_plans.pictures.motion_charts import clearance_chart
from realsim_capture_plans.pictures.plan_pictures import board_chart, coverage_chart, plan_pictures
from realsim_capture_plans.pictures.replay import NEAR_RGB, PlanReplay, near_parts, write_replay
from realsim_capture_plans.planning import view_quality
from realsim_capture_plans.planning.metrics import METRIC_MEANINGS, plan_metrics
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig
from realsim_capture_plans.planning.tour_time import TourTime
from realsim_capture_plans.planning.view_quality import D405, hole_deg
from realsim_capture_plans.planning.viewpoints import golden_cap
from refusals import refused

CENTER = np.array([0.40, 0.05, 0.05])
CONFIG = PlanConfig()
LOOKING = np.array([0.0, -1.9, -1.6, -1.2, 1.57, 0.0])
"""The arm bent over the table, the camera looking down."""
DIVE = LOOKING + np.array([0, -0.9, 0, 0, 0, 0])
"""The arm in the table."""


def plan_of(
    joints: np.ndarray, *, home: np.ndarray = LOOKING, center: np.ndarray = CENTER, **more: Any
) -> CapturePlan:
    return plan_through(joints, home, center, **({"config": CONFIG} | more))


def many(n: int, seed: int = 0, spread: float = 0.35) -> np.ndarray:
    return LOOKING + np.random.default_rng(seed).uniform(-spread, spread, (n, 6))


# --- laws -------------------------------------------------------------------------------------


def turned(plan: CapturePlan, angle: float) -> CapturePlan:
    """The same plan with everything turned about the base's axis."""
    spin = se3.exp_so3([0.0, 0.0, angle])
    by = angle * np.eye(6)[0]
    center, vias = spin @ plan.center_world, tuple((k, via + by) for k, via in plan.vias)
    home, joints = plan.home + by, plan.joints + by
    return replace(plan, home=home, joints=joints, center_world=center, vias=vias)


def test_turning_everything_about_the_base_changes_no_coverage() -> None:
    angle = 2.0
    plan = plan_of(many(60), vias=[(3, many(2, seed=5))])
    before, after = plan_metrics(plan), plan_metrics(turned(plan, angle))
    names = [n for n in before if n.startswith(("hole", "spacing", "radius", "parallax"))]
    names += ["travel_total_rad", "seconds", "sigma_min", "yoshikawa_min", "depth_noise_max_m"]
    assert len(names) >= 12
    for name in names:
        # Holes: the nearest view on the rim is looked up every quarter of a degree.
        within = 0.02 if name.startswith("hole") else 1e-9
        assert after[name] == pytest.approx(before[name], abs=within), name


def test_the_hole_is_what_a_fine_grid_finds_and_never_less() -> None:
    rng = np.random.default_rng(3)
    for n in (1, 3, 30):
        d = golden_cap(400, (15.0, 90.0))[rng.choice(400, n, replace=False)]
        sampled = view_quality.nearest_deg(d, golden_cap(60_000, (15.0, 90.0))).max()
        assert sampled - 0.02 <= hole_deg(d, (15.0, 90.0)) <= sampled + 0.4


# --- answers known beforehand -----------------------------------------------------------------


def test_time_and_travel_of_two_views_by_hand() -> None:
    # Leg 1: 1.4 rad at 1.0 rad/s, 2.0 rad/s^2: 1.4 / 1 + 1 / 2 = 1.9 s. Legs over the via: 0.32 rad
    # never reach the speed (v^2 / a = 0.5): 2 sqrt(0.32 / 2) = 0.8 s; 0.5 rad: 0.5 + 0.5 = 1.0 s.
    config = replace(CONFIG, speed=1.0, acceleration=2.0, settle_s=0.25)
    home = LOOKING
    first = home + np.array([1.4, 0.1, -0.2, 0, 0, 0])
    via = first + np.array([0, 0, 0, 0.32, 0.1, 0])
    second = via + np.array([0, 0, 0, 0, -0.5, 0.5])
    plan = plan_of(np.stack([first, second]), config=config, home=home, vias=[(1, via[None])])
    m = plan_metrics(plan)
    assert m["seconds"] == pytest.approx(1.9 + 0.8 + 1.0)
    assert m["seconds_settling"] == pytest.approx(0.5)
    assert m["seconds_total"] == pytest.approx(4.2)
    assert m["travel_leading_rad"] == pytest.approx(1.4 + 0.32 + 0.5)
    assert m["travel_total_rad"] == pytest.approx(1.7 + 0.42 + 1.0)
    assert m["largest_step_rad"] == pytest.approx(1.4)
    assert m["moves_with_vias"] == 1
    assert m["turn_base_deg"] == pytest.approx(np.degrees(1.4))
    assert m["turn_wrist_1_deg"] == pytest.approx(np.degrees(0.32))
    corners = np.stack([home, first, via, second])
    margin = np.minimum(corners - UR5.limits.lower, UR5.limits.upper - corners).min()
    assert m["limit_margin_deg"] == pytest.approx(np.degrees(margin))


def test_the_tour_s_clock_is_at_every_view_when_it_says_so() -> None:
    config = replace(CONFIG, settle_s=0.25)
    plan = plan_of(many(12), config=config, vias=[(4, many(2, seed=8)), (11, many(1, seed=9))])
    tour = TourTime.of(plan)
    assert tour.joints_at(tour.view_s) == pytest.approx(plan.joints, abs=1e-12)
    assert tour.joints_at(tour.view_s + 0.2) == pytest.approx(plan.joints, abs=1e-12)
    assert tour.joints_at(0.0) == pytest.approx(plan.home)
    assert tour.joints_at(tour.total_s + 9.0) == pytest.approx(plan.joints[-1])
    t = np.linspace(0.0, tour.total_s, 20_001)
    q, speed = tour.joints_at(t), tour.speeds_at(t)
    assert np.abs(speed).max() <= config.speed + 1e-12
    step = t[1] - t[0]
    assert np.abs(np.diff(speed, axis=0)).max() <= config.acceleration * step + 1e-9
    # Speed is the derivative of place.
    middle = (speed[1:] + speed[:-1]) / 2
    assert np.diff(q, axis=0) / step == pytest.approx(middle, abs=config.acceleration * step)
    # Samples are on the way when they say so, and no farther apart than asked.
    s = tour.samples(0.05)
    assert tour.joints_at(s.time_s) == pytest.approx(s.joints, abs=1e-6)
    assert np.abs(np.diff(s.joints, axis=0))[np.diff(s.leg) == 0].max() <= 0.05 + 1e-12
    assert np.all(np.diff(s.time_s) >= -1e-9)


def looking_down(height_m: float, box_m: float = 0.1) -> CapturePlan:
    """One view straight from above onto the middle of a flat box."""
    q = LOOKING
    camera = plan_of(q[None]).Ts_base_cam[0]
    # The mount is turned so that the optical axis is exactly down.
    down = se3.look_at(camera[:3, 3], camera[:3, 3] - [0.0, 0.0, 1.0], 0.0)
    mount = replace(d405_mount(), T_ee_cam=se3.invert(UR5.forward(q)) @ down)
    x, y, z = down[:3, 3].tolist()
    h = box_m / 2
    keep_out = Box(lower=(x - h, y - h, z - height_m), upper=(x + h, y + h, z - height_m + 1e-6))
    table = Box(lower=(-1.0, -1.0, -np.inf), upper=(1.0, 1.0, z - height_m))
    cell = WorkCell(table=table, keep_out=keep_out)
    return plan_of(q[None], mount=mount, cell=cell, center=np.array([x, y, z - height_m]))


def test_what_is_in_the_image_follows_from_the_focal_length() -> None:
    # 1280 x 720 px at f = 1000 px and 1 m depth show 1.28 m x 0.72 m.
    camera = CameraIntrinsics(width=1280, height=720, fx=1000, fy=1000, cx=639.5, cy=359.5)
    sensor = replace(D405, intrinsics=camera)
    m = plan_metrics(looking_down(0.4, box_m=0.28), sensor=sensor)
    assert m["in_view_min"] == 1.0
    assert m["nearest_depth_m"] == pytest.approx(0.4, abs=1e-5)
    assert m["depth_noise_max_m"] == pytest.approx(float(D405.depth_noise(0.4)), rel=1e-4)
    # The image shows 0.512 m x 0.288 m there. Of a box of 0.576 m, eight cells of 0.072 m each way,
    # the middles of all are within its width and those of four within its height.
    m = plan_metrics(looking_down(0.4, box_m=0.576), sensor=sensor)
    assert m["in_view_min"] == pytest.approx(8 / 8 * 4 / 8)
    assert m["seen_by_min"] == 0.0
    assert m["seen_from_min_deg"] == 0.0
    assert "overlap_min" not in m and "spacing_min_deg" not in m


def test_a_move_through_the_table_is_counted_and_its_depth_told() -> None:
    q = np.stack([LOOKING, LOOKING + 0.5 * np.eye(6)[0]])
    plan = plan_of(q, vias=[(1, DIVE[None])])
    m = plan_metrics(plan)
    assert m["colliding_legs"] >= 1
    assert m["clearance_moves_table_m"] < min(m["clearance_table_m"], plan.config.clearance_m)
    straight = plan_metrics(plan_of(q))
    assert straight["colliding_legs"] == 0
    assert m["clearance_table_m"] == pytest.approx(straight["clearance_table_m"])


def test_rolls_tilts_and_distances_of_a_board_by_hand() -> None:
    plan = looking_down(0.3)
    # The last wrist joint turns the camera about the flange; here only about its optical axis.
    rolls = np.radians([0.0, 90.0, 200.0])
    back = se3.invert(plan.mount.T_ee_cam)
    hands = [plan.Ts_base_cam[0] @ se3.exp(np.array([0, 0, r, 0, 0, 0])) @ back for r in rolls]
    joints = np.concatenate([UR5.inverse_branches(T[None])[0][:1] for T in hands])
    board = replace(plan, kind="calibration", joints=joints)
    m = plan_metrics(board)
    assert m["roll_gap_deg"] == pytest.approx(160.0, abs=1e-5)
    assert m["tilt_max_deg"] == pytest.approx(0.0, abs=1e-4)
    assert m["distance_min_m"] == pytest.approx(0.3, abs=1e-6)
    tipped = plan_metrics(board, board_normal=(0.0, np.sin(0.3), np.cos(0.3)))
    assert tipped["tilt_min_deg"] == pytest.approx(np.degrees(0.3), abs=1e-4)
    # The optical axis meets the board at the centre, however the board is tipped.
    assert tipped["distance_max_m"] == pytest.approx(0.3, abs=1e-6)
    assert "hole_deg" not in m
    refused("normal", plan_metrics, board, board_normal=(0.0, 0.0, 0.0))


# --- the table of meanings --------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["hemisphere", "calibration", "imported"])
def test_every_metric_has_a_meaning_and_a_finite_value(kind: str) -> None:
    m = plan_metrics(plan_of(many(6), kind=kind))
    assert set(m) <= set(METRIC_MEANINGS)
    assert all(isinstance(v, float) and np.isfinite(v) for v in m.values())
    for meaning in METRIC_MEANINGS.values():
        assert meaning.text and meaning.good


# --- Pictures of plans: what they draw is what the plan says, and they can be read.


def make(kind: Any = "hemisphere", n: int = 30, config: PlanConfig | None = None) -> CapturePlan:
    rng = np.random.default_rng(0)
    joints = LOOKING + rng.uniform(-0.35, 0.35, (n, 6))
    vias = ((5, LOOKING + rng.uniform(-0.3, 0.3, (2, 6))),) if n > 5 else ()
    lamp = Box(lower=(-1.0, -1.0, 0.0), upper=(-0.9, 1.0, 1.0))
    return plan_through(joints, LOOKING, CENTER, kind, (("lamp", lamp),), config, vias=vias)


@pytest.fixture(scope="module")
def curves() -> PlanCurves:
    return PlanCurves.of(make())


def texts(figure: Any) -> str:
    from matplotlib.text import Text

    return "\n".join(t.get_text() for t in figure.findobj(Text))


# --- the files --------------------------------------------------------------------------------


def test_a_handful_of_pictures_is_written_and_nothing_else(tmp_path: Path) -> None:
    from PIL import Image

    pyplot: Any = sys.modules.get("matplotlib.pyplot")
    before = pyplot.get_fignums() if pyplot else []
    paths = plan_pictures(make(n=3), tmp_path / "pictures")
    names = ["coverage", "arm", "joints", "clearance", "views"]
    assert [p.stem for p in paths] == names
    assert {p.name for p in (tmp_path / "pictures").iterdir()} == {f"{n}.png" for n in names}
    for path in paths:
        with Image.open(path) as image:
            assert min(image.size) > 500
            assert np.asarray(image.convert("L")).std() > 10  # something is drawn
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert (pyplot.get_fignums() if pyplot else []) == before


# --- what they show ---------------------------------------------------------------------------


def test_the_coverage_map_has_every_view_in_its_place(curves: PlanCurves) -> None:
    figure = coverage_chart(curves)
    axes = figure.axes[0]
    dots = next(c for c in axes.collections if c.get_label() == "view")
    azimuth, from_top = np.asarray(dots.get_offsets()).T
    s = np.sin(np.radians(from_top))
    back = np.stack([s * np.cos(azimuth), s * np.sin(azimuth), np.cos(np.radians(from_top))], -1)
    assert back == pytest.approx(curves.plan.directions(), abs=1e-9)
    hole = curves.metrics["hole_deg"]
    assert f"greatest hole, {hole:.1f}°" in texts(figure)
    # The cross is where the hole is: that far from every view, to the map's one degree.
    cross = next(c for c in axes.collections if str(c.get_label()).startswith("greatest"))
    a, r = np.asarray(cross.get_offsets())[0]
    at = np.array([np.sin(np.radians(r)) * np.cos(a), np.sin(np.radians(r)) * np.sin(a),
                   np.cos(np.radians(r))])  # fmt: skip
    angle = np.degrees(np.arccos(curves.plan.directions() @ at)).min()
    assert angle == pytest.approx(hole, abs=1.5)


def test_the_clearance_picture_names_the_worst_spot_of_every_group(curves: PlanCurves) -> None:
    shown = texts(clearance_chart(curves))
    for distance in curves.clearance.values():
        i = int(np.argmin(distance))
        named = f"{1000 * distance[i]:.1f} mm on the move to view {curves.samples.move[i]}"
        assert named in shown or 1000 * distance[i] > 100


def test_a_plan_that_does_not_keep_its_clearance_is_said_not_to_be_driven() -> None:
    plan = make()
    shown = texts(clearance_chart(PlanCurves.of(replace(plan, vias=((3, DIVE[None]),)))))
    assert "NOT KEPT" in shown and "move to view 3" in shown
    safe = PlanCurves.of(replace(plan, joints=LOOKING[None] + [[0.3, 0, 0, 0, 0, 0]], vias=()))
    assert "kept everywhere" in texts(clearance_chart(safe))


def test_the_board_picture_shows_rolls_tilts_and_places_in_the_image() -> None:
    curves = PlanCurves.of(make("calibration", n=12))
    figure = board_chart(curves)
    roll, _ = np.asarray(figure.axes[0].collections[0].get_offsets()).T
    gap = np.diff(np.sort(np.append(roll, roll.min() + 2 * np.pi))).max()
    assert np.degrees(gap) == pytest.approx(curves.metrics["roll_gap_deg"])
    assert f"{curves.metrics['roll_gap_deg']:.0f}°" in texts(figure)
    assert "board's centre" in texts(figure)


# --- The replay in the browser: it listens only here, and draws what the plan does.
SHOWN = 8


@pytest.fixture(scope="module")
def replay() -> Iterator[PlanReplay]:
    running = PlanReplay(make(n=SHOWN), port=0, looks=False)
    yield running
    running.stop()


def arm_poses(replay: PlanReplay) -> np.ndarray:
    """What the browsers are told: (7, 4, 4)."""
    frames = replay.scene._frames  # type: ignore[reportPrivateUsage]
    return np.stack([se3.from_rt(se3.from_quaternion_wxyz(f.wxyz), f.position) for f in frames])


# --- who may look -----------------------------------------------------------------------------


def test_it_answers_on_this_machine(replay: PlanReplay) -> None:
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+", replay.url)
    with urllib.request.urlopen(replay.url, timeout=20) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read().lower()


def test_a_host_that_others_reach_is_refused() -> None:
    for host in ("0.0.0.0", "::", "lab-pc"):
        refused(r"no login.*ssh -L", PlanReplay, make(n=SHOWN), host=host, port=0)


def test_a_foreign_page_cannot_connect(replay: PlanReplay) -> None:
    address = replay.url.replace("http", "ws")
    protocol: Any = [f"viser-v{__import__('viser').__version__}"]
    with pytest.raises(InvalidStatus, match="403"):
        connect(address, origin="http://evil.example", subprotocols=protocol)
    with connect(address, origin=replay.url, subprotocols=protocol):  # type: ignore[arg-type]
        pass


# --- what it draws ----------------------------------------------------------------------------


def test_the_arm_stands_where_the_tour_is(replay: PlanReplay) -> None:
    for t in (0.0, 1.234, replay.tour.total_s / 2, replay.tour.total_s):
        replay.show(t)
        expected = UR5.link_frames(replay.tour.joints_at(t))
        assert arm_poses(replay) == pytest.approx(expected, abs=1e-9)
        assert replay._slider.value == pytest.approx(t, abs=0.006)  # type: ignore[reportPrivateUsage]
    for view in (0, 3, SHOWN - 1):
        replay.show_view(view)
        assert arm_poses(replay)[6] == pytest.approx(replay.plan.Ts_base_ee[view], abs=1e-9)
        assert f"at view {view}" in replay._text.content  # type: ignore[reportPrivateUsage]
        assert replay._view.value == view  # type: ignore[reportPrivateUsage]


def test_parts_that_are_too_near_are_red_and_the_text_says_so(replay: PlanReplay) -> None:
    assert near_parts(replay.model, LOOKING) == set()
    near = near_parts(replay.model, DIVE)
    assert near & set(replay.scene.parts)
    assert not near & {"base", "shoulder"}  # they stand on the table
    replay.scene.mark(near)
    for name, drawn in replay.scene.parts.items():
        for node, own in drawn:
            assert tuple(node.color) == (NEAR_RGB if name in near else own)
    replay.scene.mark(set())
    assert all(tuple(n.color) == own for drawn in replay.scene.parts.values() for n, own in drawn)
    assert "TOO NEAR" not in replay.describe(0.0)


# --- the file ---------------------------------------------------------------------------------


def test_the_file_holds_the_whole_tour(tmp_path: Path) -> None:
    import msgspec
    import zstandard

    plan = make(n=SHOWN)
    path = write_replay(plan, tmp_path / "replay.html", looks=False)
    found = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', path.read_text())
    assert found
    data = base64.b64decode(found[1])
    size = int.from_bytes(data[:8], "little")
    inner = zstandard.ZstdDecompressor().decompress(data[8:], max_output_size=size)
    content = msgspec.msgpack.decode(inner[8 : 8 + int.from_bytes(inner[:8], "little")])
    assert content["durationSeconds"] > 1.0
    hand = [
        m["position"]
        for _, m in content["messages"]
        if m["type"] == "SetPositionMessage" and m["name"] == "/arm/6"
    ]
    # The flange passes every view.
    gap = np.linalg.norm(np.array(hand)[None] - plan.Ts_base_ee[:, None, :3, 3], axis=-1)
    assert gap.min(axis=1).max() < 0.02
    assert sorted(tmp_path.iterdir()) == [path]
