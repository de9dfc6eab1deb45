"""Pictures of plans: what they draw is what the plan says, and they can be read."""

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
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.arm import UR5
from realsim.robots.shapes import Box
from realsim_capture_plans.pictures.drawing import PlanCurves
from realsim_capture_plans.pictures.motion_charts import clearance_chart
from realsim_capture_plans.pictures.plan_pictures import plan_pictures
from realsim_capture_plans.pictures.replay import NEAR_RGB, PlanReplay, near_parts, write_replay
from realsim_capture_plans.pictures.view_charts import board_chart, coverage_chart
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig

CENTER = np.array([0.40, 0.05, 0.05])
LOOKING = np.array([0.0, -1.9, -1.6, -1.2, 1.57, 0.0])
"""The arm bent over the table, the camera looking down."""
N = 30


def make(kind: Any = "hemisphere", n: int = N, config: PlanConfig | None = None) -> CapturePlan:
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
    assert sorted(p.name for p in (tmp_path / "pictures").iterdir()) == sorted(
        f"{name}.png" for name in names
    )
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
    dive = (LOOKING - 0.9 * np.eye(6)[1])[None]
    broken = PlanCurves.of(replace(plan, vias=((3, dive),)))
    shown = texts(clearance_chart(broken))
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
DIVE = LOOKING + np.array([0, -0.9, 0, 0, 0, 0])
"""The arm in the table."""
SHOWN = 8


@pytest.fixture(scope="module")
def replay() -> Iterator[PlanReplay]:
    running = PlanReplay(make(n=SHOWN), port=0, looks=False)
    yield running
    running.stop()


def arm_poses(replay: PlanReplay) -> np.ndarray:
    """What the browsers are told: (7, 4, 4)."""
    return np.stack(
        [
            se3.from_rt(se3.from_quaternion_wxyz(f.wxyz), f.position)
            for f in replay.scene._frames  # type: ignore[reportPrivateUsage]
        ]
    )


# --- who may look -----------------------------------------------------------------------------


def test_it_answers_on_this_machine(replay: PlanReplay) -> None:
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+", replay.url)
    with urllib.request.urlopen(replay.url, timeout=20) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read().lower()


def test_a_host_that_others_reach_is_refused() -> None:
    for host in ("0.0.0.0", "::", "lab-pc"):
        with pytest.raises(InputError, match=r"no login.*ssh -L"):
            PlanReplay(make(n=SHOWN), host=host, port=0)


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
    page = path.read_text()
    found = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)
    assert found
    data = base64.b64decode(found[1])
    inner = zstandard.ZstdDecompressor().decompress(
        data[8:], max_output_size=int.from_bytes(data[:8], "little")
    )
    length = int.from_bytes(inner[:8], "little")
    content = msgspec.msgpack.decode(inner[8 : 8 + length])
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
