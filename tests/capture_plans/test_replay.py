"""The replay in the browser: it listens only here, and draws what the plan does."""

import base64
import re
import urllib.request
from collections.abc import Iterator
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
from realsim_capture_plans.pictures.replay import (
    NEAR_RGB,
    PlanReplay,
    near_parts,
    serve_replay,
    write_replay,
)
from realsim_capture_plans.planning.record import CapturePlan

CENTER = np.array([0.40, 0.05, 0.05])
LOOKING = np.array([0.0, -1.9, -1.6, -1.2, 1.57, 0.0])
DIVE = LOOKING + np.array([0, -0.9, 0, 0, 0, 0])
"""The arm in the table."""
N = 8


def make() -> CapturePlan:
    joints = LOOKING + np.random.default_rng(0).uniform(-0.3, 0.3, (N, 6))
    lamp = Box(lower=(-1.0, -1.0, 0.0), upper=(-0.9, 1.0, 1.0))
    vias = ((5, LOOKING[None] + 0.1),)
    return plan_through(joints, LOOKING, CENTER, obstacles=(("lamp", lamp),), vias=vias)


@pytest.fixture(scope="module")
def replay() -> Iterator[PlanReplay]:
    running = serve_replay(make(), port=0, looks=False)
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
            serve_replay(make(), host, 0)


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
    for view in (0, 3, N - 1):
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

    plan = make()
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
