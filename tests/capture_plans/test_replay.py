"""The replay in the browser: it listens only here, and draws what the plan does."""

import base64
import io
import json
import re
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from realsim.errors import InputError
from realsim.geometry import se3
from realsim_capture_plans.arms.kinematics import UR5
from realsim_capture_plans.collision.mount import d405_mount
from realsim_capture_plans.collision.shapes import Box
from realsim_capture_plans.pictures.replay import (
    NEAR_RGB,
    PlanReplay,
    near_parts,
    serve_replay,
    write_replay,
)
from realsim_capture_plans.planning.record import CapturePlan, PlanConfig

CENTER = np.array([0.40, 0.05, 0.05])
LOOKING = np.array([0.0, -1.9, -1.6, -1.2, 1.57, 0.0])
DIVE = LOOKING + np.array([0, -0.9, 0, 0, 0, 0])
"""The arm in the table."""
N = 8


def make() -> CapturePlan:
    rng = np.random.default_rng(0)
    config = PlanConfig()
    lamp = Box(lower=(-1.0, -1.0, 0.0), upper=(-0.9, 1.0, 1.0))
    return CapturePlan(
        kind="hemisphere",
        chain=UR5,
        mount=d405_mount(),
        cell=config.work_cell(CENTER, "hemisphere", (("lamp", lamp),)),
        home=LOOKING,
        joints=LOOKING + rng.uniform(-0.3, 0.3, (N, 6)),
        center_world=CENTER,
        vias=((5, LOOKING[None] + 0.1),),
        reference_view=0,
        config=config,
    )


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


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "::", "lab-pc"])
def test_a_host_that_others_reach_is_refused(host: str) -> None:
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


def test_a_person_s_slider_moves_the_arm_and_the_arm_s_slider_does_not(replay: PlanReplay) -> None:
    from viser import GuiEvent

    replay.show_view(1)
    slider, view = replay._slider, replay._view  # type: ignore[reportPrivateUsage]
    slider.value = 0.5  # what `show` does while playing
    assert replay.time_s == pytest.approx(replay.tour.view_s[1])
    person: Any = object()

    def by_hand(control: Any) -> None:
        for callback in control._impl.update_cb:
            callback(GuiEvent(client_id=0, client=person, target=control))

    by_hand(slider)
    assert replay.time_s == pytest.approx(0.5)
    view.value = 3
    by_hand(view)
    assert replay.time_s == pytest.approx(replay.tour.view_s[3])


def test_steps_go_from_view_to_view(replay: PlanReplay) -> None:
    replay.show_view(2)
    step = replay._step  # type: ignore[reportPrivateUsage]
    step(1)
    assert replay.time_s == pytest.approx(replay.tour.view_s[3])
    step(-1)
    assert replay.time_s == pytest.approx(replay.tour.view_s[2])
    replay.show(replay.tour.view_s[3] - 0.1)  # on the way to 3
    step(-1)
    assert replay.time_s == pytest.approx(replay.tour.view_s[2])
    replay.show_view(0)
    step(-1)
    assert replay.time_s == pytest.approx(replay.tour.view_s[0])


def test_the_scene_has_arm_camera_table_boxes_and_views(replay: PlanReplay) -> None:
    names = set(replay.server.scene._handle_from_node_name)  # type: ignore[reportPrivateUsage]
    assert {"/table", "/keep-out box", "/obstacles/lamp", "/views", "/arm/6/field of view"} <= names
    parts = set(replay.scene.parts)
    assert {"forearm", "wrist 3", "camera"} <= parts
    # Every view's frustum begins at its camera.
    lines = np.asarray(replay.server.scene._handle_from_node_name["/views"].points)  # type: ignore[reportPrivateUsage]
    starts = lines.reshape(N, -1, 2, 3)[:, 0, 0]
    assert starts == pytest.approx(replay.plan.Ts_base_cam[:, :3, 3], abs=1e-6)


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


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
BROWSER_ARGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--disable-background-networking",
    "--disable-dev-shm-usage", "--window-size=1000,700", "--remote-debugging-port=0",
)  # fmt: skip


def photographed(url: str, folder: Path, seconds: float = 60.0) -> np.ndarray:
    """Open a page in a headless browser until it shows something orange; return its picture."""
    from PIL import Image

    command = [str(CHROMIUM), *BROWSER_ARGS, f"--user-data-dir={folder}", url]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        found = (re.search(r"ws://127\.0\.0\.1:(\d+)/", line) for line in process.stderr)
        port = next(m[1] for m in found if m)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=20) as answer:
            page = next(p for p in json.load(answer) if p["type"] == "page")
        image = np.zeros((1, 1, 3), dtype=int)
        with connect(page["webSocketDebuggerUrl"], max_size=None) as socket:
            end = time.monotonic() + seconds
            while time.monotonic() < end and orange(image) < 20:
                time.sleep(1.0)
                socket.send('{"id": 1, "method": "Page.captureScreenshot"}')
                reply = json.loads(socket.recv(timeout=60))
                png = base64.b64decode(reply["result"]["data"])
                image = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
        return image
    finally:
        process.kill()
        process.wait()


def orange(image: np.ndarray) -> int:
    """Return how many pixels are of the keep-out box."""
    r, g, b = np.moveaxis(image, -1, 0)
    return int(np.sum((r > 150) & (b < 0.6 * r) & (g > 0.5 * r) & (g < 0.9 * r)))


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_in_chromium_the_file_draws_the_scene_without_a_server(tmp_path: Path) -> None:
    path = write_replay(make(), tmp_path / "replay.html", looks=False)
    image = photographed(path.as_uri(), tmp_path / "profile")
    assert orange(image) >= 20  # the keep-out box
    assert image[150:550, 200:800].std() > 8  # and more than that
