"""The review server: what it shows, who may enter, and that decisions only ever add lines."""

import base64
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
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from realsim import (
    CameraIntrinsics,
    CaptureSession,
    GraspSet,
    InputError,
    Mesh,
    ObjectModel,
    ObjectPose,
    Scene,
    SupportPlane,
    View,
    local_pages,
)
from realsim.formats.bop.models import save_models
from realsim.geometry import se3
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.review import ReviewServer, content, journal
from realsim.review.scene_nodes import GraspFilter
from realsim.store import SessionStore, save_grasps, save_scene

INTRINSICS = CameraIntrinsics(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
SOCKET = viser.__name__ + "-v" + viser.__version__


def box(size: tuple[float, float, float]) -> Mesh:
    s = (
        np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        * np.array(size)
        / 2
    )
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    return Mesh(vertices=s, faces=np.array(faces, np.int32))


MODELS = {
    1: ObjectModel(obj_id=1, name="tall", mesh=box((0.04, 0.04, 0.12))),
    7: ObjectModel(obj_id=7, name="flat", mesh=box((0.08, 0.06, 0.03))),
}
SCENE = Scene(
    name="two boxes",
    objects=(
        ObjectPose(
            obj_id=1, instance=0, T_world_obj=se3.from_translation([0.46, 0.0, 0.06]),
            verdict="accepted", checks={"agree": 0.98},
        ),
        ObjectPose(
            obj_id=7, instance=3, T_world_obj=se3.from_translation([0.55, 0.02, 0.015]),
            verdict="doubtful", reasons=("seen by one view",), checks={"agree": 0.71},
        ),
    ),
    plane=SupportPlane(T_world_table=se3.from_translation([0.5, 0.0, 0.0])),
)  # fmt: skip
CAMERAS = [
    se3.look_at([0.5 + 0.4 * np.cos(a), 0.4 * np.sin(a), 0.3], [0.5, 0.0, 0.03])
    for a in (0.0, 2.0, 4.0)
]


def grasp_set(n: int = 40) -> GraspSet:
    rng = np.random.default_rng(0)
    Ts = se3.from_rt(np.diag([1.0, -1.0, -1.0]), rng.normal(scale=0.01, size=(n, 3)))
    nan4 = np.full((n, 4), np.nan)
    return GraspSet(
        obj_id=1, instance=0, Ts_obj_grasp=Ts, widths_m=np.full(n, 0.05),
        scores=np.append(np.linspace(0, 1, n - 1), np.nan), base_scores=np.zeros(n), slip_m=nan4,
        slip_rad=nan4, reachable=np.arange(n) % 2 == 0, failures=("",) * n,
    )  # fmt: skip


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SessionStore:
    session = CaptureSession(name="boxes", intrinsics=INTRINSICS, views=(), depth_unit_m=1e-4)
    store = SessionStore.create(tmp_path_factory.mktemp("review") / "boxes", session)
    table = PlacedMesh(-1, box((1.0, 1.0, 0.02)), se3.from_translation([0.5, 0.0, -0.01]))
    placed = [PlacedMesh(o.instance, MODELS[o.obj_id].mesh, o.T_world_obj) for o in SCENE.objects]
    renderer = LabelRenderer([*placed, table])
    for index, T in enumerate(CAMERAS):
        labels = renderer.render(INTRINSICS, T)
        rgb = np.stack([np.where(labels.ids == 0, 200, 90)] * 3, -1).astype(np.uint8)
        store.add_view(View(index=index, T_world_cam=T), rgb, labels.depth_m)
    save_scene(store, SCENE)
    save_grasps(store, grasp_set())
    save_models(store.folder / "models", MODELS)
    return store


@pytest.fixture(scope="module")
def server(store: SessionStore) -> Iterator[ReviewServer]:
    review = ReviewServer(store, port=0)
    review.start()
    yield review
    review.stop()


# --- content ----------------------------------------------------------------------------------


def test_worst_comes_first() -> None:
    assert [o.instance for o in content.worst_first(SCENE.objects)] == [3, 0]


def test_the_fused_cloud_lies_on_the_surfaces(store: SessionStore) -> None:
    views = content.placed_views(store)
    region = content.region_of(SCENE.objects, views, 0.2)
    points, colors = content.fused_cloud(store, views, 0.002, 50_000, region)
    assert points.dtype == np.float32 and len(points) == len(colors) > 2000
    assert np.all(region.holds(points))
    on_table = np.abs(points[:, 2]) < 2e-4
    # Everything above the table is on the shell of one of the boxes.
    d = np.min(
        [
            np.abs(np.abs(points - o.T_world_obj[:3, 3]) - MODELS[o.obj_id].mesh.extent / 2).min(1)
            for o in SCENE.objects
        ],
        axis=0,
    )
    # A voxel that holds points of two faces averages across the edge.
    assert np.mean(on_table | (d < 5e-4)) > 0.97
    fewer, _ = content.fused_cloud(store, views, 0.002, 500, region)
    assert len(fewer) <= 500


def test_a_strided_camera_sees_the_same_points() -> None:
    from realsim.geometry import camera

    lens = CameraIntrinsics(
        width=161, height=121, fx=150.0, fy=152.0, cx=80.2, cy=59.1,
        distortion=np.array([-0.05, 0.06, 3e-4, 5e-4, -0.02]),
    )  # fmt: skip
    for stride in (1, 2, 3, 7):
        small = content.strided(lens, stride)
        rays = camera.ray_table(lens)[::stride, ::stride]
        np.testing.assert_allclose(camera.ray_table(small), rays, atol=1e-6)


def test_grippers_are_drawn_where_the_contacts_are() -> None:
    rng = np.random.default_rng(1)
    Ts, widths = se3.random_transform(rng, 9), rng.uniform(0.01, 0.1, 9)
    lines = content.gripper_segments(Ts, widths, content.GripperDrawing())
    tips = lines[:, :2, 0]
    np.testing.assert_allclose(np.linalg.norm(tips[:, 1] - tips[:, 0], axis=1), widths, atol=1e-12)
    np.testing.assert_allclose(tips.mean(1), Ts[:, :3, 3], atol=1e-12)
    fingers = lines[:, 0, 0] - lines[:, 0, 1]  # from palm to tip: the approach
    np.testing.assert_allclose(fingers / 0.035, Ts[:, :3, 2], atol=1e-12)


def test_filters_nest_and_keep_the_spread_of_scores() -> None:
    grasps = grasp_set()
    every = set(content.chosen_grasps(grasps, 0.0, False, 1000).tolist())
    assert every == set(range(40))
    for reachable in (False, True):
        tighter = [
            set(content.chosen_grasps(grasps, s, reachable, 1000).tolist()) for s in (0, 0.3, 0.8)
        ]
        assert tighter[2] < tighter[1] < tighter[0]
        assert all(grasps.scores[i] >= 0.8 for i in tighter[2])
    few = content.chosen_grasps(grasps, 0.0, False, 5)
    assert len(few) == 5 and np.nanmin(grasps.scores[few]) < 0.3 and grasps.scores[few].max() != 0


def test_without_objects_the_region_is_where_the_cameras_look() -> None:
    views = [View(index=i, T_world_cam=T) for i, T in enumerate(CAMERAS)]
    region = content.region_of([], views, 0.2)
    np.testing.assert_allclose(region.center, [0.5, 0.0, 0.03], atol=1e-9)


def test_linear_light_of_known_colours() -> None:
    rgb = np.array([[0, 128, 255]], np.uint8)
    np.testing.assert_array_equal(content.linear_rgb(rgb), [[0, 55, 255]])


# --- who may enter ----------------------------------------------------------------------------


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", "example.org", ""])
def test_other_machines_are_refused(store: SessionStore, host: str) -> None:
    with pytest.raises(InputError, match="no login"):
        ReviewServer(store, host=host)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_loopback_is_accepted(host: str) -> None:
    assert local_pages.check_host(host, "the review") == host


def test_the_page_is_served(server: ReviewServer) -> None:
    with urllib.request.urlopen(server.url, timeout=10) as page:
        assert page.status == 200 and b"<html" in page.read().lower()


def test_foreign_pages_are_refused_and_own_pages_get_the_scene(server: ReviewServer) -> None:
    address = server.url.replace("http", "ws", 1)
    for origin in ("https://evil.example", "http://127.0.0.1.evil.example", "null"):
        with pytest.raises(InvalidStatus) as refused:
            connect(address, origin=origin, subprotocols=[SOCKET])  # type: ignore[list-item]
        assert refused.value.response.status_code == 403
    own = server.url
    with connect(address, origin=own, subprotocols=[SOCKET], max_size=None) as socket:  # type: ignore
        assert len(socket.recv(timeout=10)) > 0


def test_other_servers_are_not_touched_by_the_guard() -> None:
    from websockets.asyncio import server as module

    before: Any = module.serve
    with local_pages.local_origins_only():
        assert module.serve is not before
    assert module.serve is before


def test_nobody_can_ask_for_a_public_tunnel(server: ReviewServer) -> None:
    from viser import _messages

    handlers = server._running()._websock_server._incoming_handlers  # type: ignore[reportPrivateUsage]
    assert _messages.ShareUrlRequest not in handlers


# --- decisions --------------------------------------------------------------------------------


def test_decisions_are_replayed_shown_and_undone(store: SessionStore, server: ReviewServer) -> None:
    everything_else = {
        p: p.read_bytes()
        for p in store.folder.rglob("*")
        if p.is_file() and "review" not in p.parts
    }
    start = len(server.state.entries)
    server.reject(3, "ada", "it floats")
    judged = journal.reviewed_scene(server.scene, server.state)
    assert judged.object(3).verdict == "rejected" and judged.object(0).verdict == "accepted"
    assert "rejected" in server._cards[3].folder.label  # type: ignore[reportPrivateUsage]
    assert "it floats" in server._cards[3].text.content  # type: ignore[reportPrivateUsage]
    server.undo(3, "ada")
    assert journal.reviewed_scene(server.scene, server.state).object(3).verdict == "doubtful"
    server.accept(3, "bob")
    server.comment(0, "bob", "nice")
    assert [e.action for e in server.state.entries[start:]] == [
        "reject", "undo", "accept", "comment",
    ]  # fmt: skip
    for path, data in everything_else.items():
        assert path.read_bytes() == data
    again = ReviewServer(store, port=0)
    assert again.state == server.state


def test_unsigned_presses_record_nothing_and_say_why(server: ReviewServer) -> None:
    before = server.state
    card = server._cards[0]  # type: ignore[reportPrivateUsage]
    server._press(lambda: server.accept(0, "  "), card)  # type: ignore[reportPrivateUsage]
    assert "name" in server._message.content and server.state == before  # type: ignore
    with pytest.raises(InputError, match="instance 99"):
        server.accept(99, "ada")


def test_a_decision_of_another_server_shows_up(store: SessionStore, server: ReviewServer) -> None:
    other = ReviewServer(store, port=0)
    other.reject(0, "carol")
    server.refresh()
    assert "rejected" in server._cards[0].folder.label  # type: ignore[reportPrivateUsage]
    other.undo(0, "carol")


def test_grasp_filters_draw_what_passes(server: ReviewServer) -> None:
    assert server.filter_grasps(GraspFilter()) == 40
    assert server.filter_grasps(GraspFilter(min_score=0.5)) == np.sum(grasp_set().scores >= 0.5)
    assert server.filter_grasps(GraspFilter(reachable_only=True)) == 20
    assert server.filter_grasps(GraspFilter(instance=3)) == 0
    assert server.filter_grasps(GraspFilter(show=False)) == 0
    assert server.filter_grasps(GraspFilter()) == 40


def test_an_unregistered_session_is_refused(tmp_path: Path) -> None:
    session = CaptureSession(name="raw", intrinsics=INTRINSICS, views=(), depth_unit_m=1e-4)
    with pytest.raises(InputError, match=r"scene\.json"):
        ReviewServer(SessionStore.create(tmp_path / "s", session))


# --- in a real browser ------------------------------------------------------------------------

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
BROWSER_ARGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--disable-background-networking",
    "--disable-dev-shm-usage", "--window-size=1200,800", "--remote-debugging-port=0",
)  # fmt: skip


class Page:
    """A page of a headless browser, steered over the DevTools protocol."""

    def __init__(self, folder: Path, url: str) -> None:
        command = [str(CHROMIUM), *BROWSER_ARGS, f"--user-data-dir={folder}", "about:blank"]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        assert self.process.stderr is not None
        port = next(
            m[1]
            for line in self.process.stderr
            if (m := re.search(r"ws://127\.0\.0\.1:(\d+)/", line))
        )
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=20) as answer:
            page = next(p for p in json.load(answer) if p["type"] == "page")
        self.socket = connect(page["webSocketDebuggerUrl"], max_size=None)
        self.calls = 0
        self.call("Page.navigate", url=url)

    def call(self, method: str, **params: Any) -> Any:
        self.calls += 1
        self.socket.send(json.dumps({"id": self.calls, "method": method, "params": params}))
        while True:
            answer = json.loads(self.socket.recv(timeout=60))
            if answer.get("id") == self.calls:
                return answer["result"]

    def run(self, script: str) -> Any:
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        return result["result"].get("value")

    def wait_for(self, text: str, seconds: float = 60.0) -> str:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            shown = self.run("document.body ? document.body.innerText : ''") or ""
            if text in shown:
                return shown
            time.sleep(0.3)
        raise AssertionError(f"'{text}' did not appear; the page shows: {shown}")

    def close(self) -> None:
        self.socket.close()
        self.process.kill()
        self.process.wait()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_in_chromium_the_panel_decides(server: ReviewServer, tmp_path: Path) -> None:
    page = Page(tmp_path / "profile", server.url)
    try:
        page.wait_for("Your name")
        page.wait_for("3 flat")
        shown = page.wait_for("0 tall")
        assert shown.index("3 flat") < shown.index("0 tall")  # worst first
        page.run(
            "[...document.querySelectorAll('button')].find(b => b.innerText == 'Accept').click()"
        )
        page.wait_for("Not recorded")
        server._reviewer.value = "dora"  # type: ignore[reportPrivateUsage]
        page.run(
            "[...document.querySelectorAll('button')].find(b => b.innerText == 'Reject').click()"
        )
        page.wait_for("Recorded: reject by dora")
        assert server.state.entries[-1].reviewer == "dora"
        assert server.state.entries[-1].instance == 3
        picture = base64.b64decode(page.call("Page.captureScreenshot", format="png")["data"])
        (tmp_path / "page.png").write_bytes(picture)
        server.undo(3, "dora")
    finally:
        page.close()
    import cv2

    image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    left = np.asarray(image)[150:, :700].astype(int)
    assert left.std() > 5  # the scene is drawn, not a blank canvas
