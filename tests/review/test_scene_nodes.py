"""The scene's nodes on a real viser server, and what a client of its protocol is sent of them."""

import sys
import threading
import time
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import viser

from realsim.geometry import se3
from realsim.review.content.content import SceneContent
from realsim.review.drawing.scene_nodes import GraspFilter, SceneNodes
from realsim.review.placing.ellipsoid import ellipsoid_of
from refusals import refused
from reviewed_boxes import CAMERAS, CONFIG, SCENE

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

from review_client import Browser


def opened(server: viser.ViserServer) -> Browser:
    return Browser.open(f"http://127.0.0.1:{server.get_port()}")


@pytest.fixture
def nodes(server: viser.ViserServer, shown: SceneContent) -> SceneNodes:
    built = SceneNodes(server.scene, shown, CONFIG)
    built.build()
    built.cloud.refine(CONFIG.shown_points)
    assert built.cloud.wait(20)
    return built


def states(server: viser.ViserServer) -> dict[str, tuple[Any, ...]]:
    """Name -> pose, visibility and type of every node of the server."""
    handles = server.scene._handle_from_node_name  # type: ignore[reportPrivateUsage]
    return {
        name: (*h.wxyz.tolist(), *h.position.tolist(), h.visible, type(h).__name__)
        for name, h in handles.items()
    }


def test_a_client_is_sent_the_very_points_photographs_and_poses(
    server: viser.ViserServer, nodes: SceneNodes, shown: SceneContent
) -> None:
    client = opened(server)
    client.until_quiet(0.5)
    pieces = client.of_type("PointCloudMessage")
    points = np.concatenate([client.array(m, "points") for m in pieces])
    colors = np.concatenate([client.array(m, "colors", np.uint8) for m in pieces])
    n = len(points) // 3
    assert 1000 <= n < 1000 + CONFIG.piece_points
    np.testing.assert_array_equal(points.reshape(-1, 3), shown.cloud.points[:n])
    np.testing.assert_array_equal(colors.reshape(-1, 3), shown.cloud.colors[:n])
    assert len(client.array(pieces[0], "points")) == 3 * shown.cloud.ends[0]
    positions = {m["name"]: m["position"] for m in client.of_type("SetPositionMessage")}
    for index, T in enumerate(CAMERAS):
        np.testing.assert_allclose(positions[f"/cameras/{index:06d}"], T[:3, 3], atol=1e-6)
    for placed in SCENE.objects:
        where = positions[f"/objects/{placed.instance}"]
        np.testing.assert_allclose(where, placed.T_world_obj[:3, 3], atol=1e-6)
    sent = [m["updates"].get("_image_data") for m in client.of_type("SceneNodeUpdateMessage")]
    photographs = {bytes(b) for b in sent if isinstance(b, bytes | memoryview)}
    assert photographs == set(shown.thumbnails.values())
    glbs = {bytes(m["props"]["glb_data"]) for m in client.of_type("GlbMessage")}
    assert glbs == {shown.meshes[1].glb, shown.meshes[7].glb}


def test_place_and_place_back_leaves_every_node_as_it_was(
    server: viser.ViserServer, nodes: SceneNodes
) -> None:
    before = states(server)
    moved = se3.random_transform(np.random.default_rng(0))
    nodes.place(0, moved)
    during = states(server)
    assert {name for name in before if during[name] != before[name]} == {"/objects/0"}
    np.testing.assert_allclose(during["/objects/0"][4:7], moved[:3, 3], atol=1e-9)
    nodes.place(0, SCENE.object(0).T_world_obj)
    after = states(server)
    assert after.keys() == before.keys()
    for name, state in after.items():
        np.testing.assert_allclose(state[:7], before[name][:7], atol=1e-9)
        assert state[7:] == before[name][7:]


def test_switches_show_one_look_at_a_time_and_colours_follow_the_verdict(
    server: viser.ViserServer, nodes: SceneNodes
) -> None:
    def seen(instance: int) -> list[bool]:
        now, of = states(server), f"/objects/{instance}/"
        return [now.get(of + kind, (False, ""))[-2] for kind in ("appearance", "verdict")]

    assert seen(0) == [True, False]
    nodes.color_verdict(0, "rejected")  # before it was ever shown so
    nodes.show_objects("verdict")
    assert seen(0) == seen(3) == [False, True]
    judged: Any = server.scene.get_handle_by_name("/objects/0/verdict")
    assert tuple(judged.color) == (222, 76, 10)
    nodes.color_verdict(0, "accepted")
    assert tuple(judged.color) == (0, 170, 130)
    nodes.show_objects("hidden")
    assert seen(0) == [False, False]
    nodes.show_objects("appearance")
    assert seen(0) == [True, False]
    for switch, name in (
        (nodes.cloud.show, "/cloud"), (nodes.show_cameras, "/cameras"), (nodes.show_table, "/table")
    ):  # fmt: skip
        switch(False)
        assert not states(server)[name][-2]
        switch(True)
        assert states(server)[name][-2]


def test_colours_of_the_cloud_are_set_in_its_order_and_taken_back(
    server: viser.ViserServer, nodes: SceneNodes, shown: SceneContent
) -> None:
    colors = np.random.default_rng(0).integers(0, 256, shown.cloud.points.shape, dtype=np.uint8)

    def sent() -> np.ndarray:
        handles = server.scene._handle_from_node_name  # type: ignore[reportPrivateUsage]
        names = sorted((n for n in handles if n.startswith("/cloud/")), key=lambda n: int(n[7:]))
        return np.concatenate([cast(Any, handles[n]).colors for n in names])

    nodes.cloud.color(colors)
    n = len(sent())
    np.testing.assert_array_equal(sent(), colors[:n])
    nodes.cloud.refine()  # pieces that come later are coloured likewise
    assert nodes.cloud.wait(20)
    np.testing.assert_array_equal(sent(), colors)
    nodes.cloud.color(None)
    np.testing.assert_array_equal(sent(), shown.cloud.colors)
    handle: Any = server.scene.get_handle_by_name("/cloud/1")
    assert np.shares_memory(handle.points, shown.cloud.points)  # and is no window's own
    refused("colours", nodes.cloud.color, colors[:-1])


def test_grasps_are_one_node_at_their_poses_and_a_click_tells_the_row(
    server: viser.ViserServer, nodes: SceneNodes, shown: SceneContent
) -> None:
    clicked: list[tuple[int, int]] = []
    done = threading.Event()
    nodes.grasps.on_click(lambda instance, row: (clicked.append((instance, row)), done.set()))
    moved = se3.random_transform(np.random.default_rng(2))
    drawn = nodes.draw_grasps(GraspFilter(stage=4), {3: moved})
    expected = [
        (g.instance, int(r)) for g in shown.grasp_sets for r in np.flatnonzero(g.base_scores == 1)
    ]
    assert drawn == len(expected) > 10
    client = opened(server)
    client.until_quiet(0.5)
    (message,) = client.of_type("BatchedMeshesMessage")
    positions = client.array(message, "batched_positions").reshape(-1, 3)
    scales = client.array(message, "batched_scales").reshape(-1, 3)
    for k, (instance, row) in enumerate(expected):
        grasps = shown.grasps_of(instance)
        assert grasps is not None
        T = moved if instance == 3 else SCENE.object(instance).T_world_obj
        np.testing.assert_allclose(positions[k], (T @ grasps.Ts_obj_grasp[row])[:3, 3], atol=1e-6)
        assert scales[k, 1] == pytest.approx(grasps.widths_m[row], rel=1e-6)
    for index in (0, drawn - 1):
        done.clear()
        client.click_node("/grasps", message["owner"], index)
        assert done.wait(10)
        assert clicked[-1] == expected[index]
    assert nodes.draw_grasps(GraspFilter(show=False)) == 0
    assert "/grasps" not in states(server)


def test_highlight_and_ellipsoids_come_and_go(server: viser.ViserServer, nodes: SceneNodes) -> None:
    before = states(server)
    nodes.highlight(3)
    assert set(states(server)) - set(before) == {"/objects/3/box"}
    nodes.highlight(0)
    assert set(states(server)) - set(before) == {"/objects/0/box"}
    nodes.highlight(None)
    shape = ellipsoid_of(SCENE.object(0), 2.0, 10.0)
    assert shape is not None
    nodes.ellipsoids({0: shape, 3: None})
    assert {n for n in states(server) if n.startswith("/ellipsoids/")} == {"/ellipsoids/0"}
    nodes.ellipsoids({})
    assert {n for n in states(server) if "ellipsoids/" in n} == set()


def test_unknown_objects_are_named(nodes: SceneNodes) -> None:
    for call in (
        lambda: nodes.place(9, np.eye(4)), lambda: nodes.highlight(9), lambda: nodes.swap(9, 1),
        lambda: nodes.color_verdict(9, "accepted"),
    ):  # fmt: skip
        refused("0, 3", call)
    refused("verdict", nodes.color_verdict, 0, "fine")
    refused("no mesh", nodes.swap, 0, 77)
    refused("hidden", nodes.show_objects, "upside down")


def test_clear_takes_everything_away_and_stops_the_background(
    server: viser.ViserServer, shown: SceneContent
) -> None:
    empty = set(states(server))
    built = SceneNodes(server.scene, shown, CONFIG)
    built.build()
    built.cloud.refine()
    built.draw_grasps(GraspFilter())
    built.highlight(0)
    built.ellipsoids({0: ellipsoid_of(SCENE.object(0))})
    built.clear()
    assert built.cloud.wait(20)
    left = {n for n in states(server) if n not in empty}
    assert left <= {"/objects", "/ellipsoids"}  # empty anchors that viser made itself
    built.clear()
    built.build()
    asked: list[bool] = []
    built.cloud.refine(CONFIG.shown_points, lambda: asked.append("/cloud/1" in states(server)))
    assert built.cloud.wait(20) and "/cloud/1" in states(server)
    assert asked == [False]  # finer points leave only then


def test_each_browser_has_its_own_scene_and_the_coarse_cloud_comes_first(
    server: viser.ViserServer, shown: SceneContent
) -> None:
    made: list[SceneNodes] = []
    ready = threading.Semaphore(0)

    def build(client: viser.ClientHandle) -> None:
        nodes = SceneNodes(client.scene, shown, CONFIG)
        nodes.build()
        nodes.cloud.refine()
        made.append(nodes)
        ready.release()

    server.on_client_connect(build)
    first, second = opened(server), opened(server)
    assert ready.acquire(timeout=20) and ready.acquire(timeout=20)
    end = time.monotonic() + 20
    while time.monotonic() < end and not all(n.cloud.wait(0.1) for n in made):
        first.receive(0.05), second.receive(0.05)
    for client in (first, second):
        client.until_quiet(0.5)
        pieces = client.of_type("PointCloudMessage")
        assert [m["name"] for m in pieces] == [f"/cloud/{k}" for k in range(len(pieces))]
        points = np.concatenate([client.array(m, "points") for m in pieces])
        np.testing.assert_array_equal(points.reshape(-1, 3), shown.cloud.points)
        names = [
            m["name"] for m in client.messages if m["type"].endswith("Message") and "name" in m
        ]
        assert names.index("/cloud/0") < names.index("/cameras/000003") < names.index("/cloud/2")
    made[0].place(0, se3.random_transform(np.random.default_rng(0)))
    told: list[bool] = []
    for client in (first, second):
        before = len(client.of_type("SetPositionMessage"))
        client.until_quiet(0.5)
        told.append(len(client.of_type("SetPositionMessage")) > before)
    assert sorted(told) == [False, True]
