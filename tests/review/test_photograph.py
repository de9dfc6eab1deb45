"""The photographs as an instrument: what each says of the poses, to the pixel."""

import io
import threading
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viser
from PIL import Image

from realsim import local_pages
from realsim.arrays import Rgb
from realsim.geometry import camera, se3
from realsim.records import ObjectPose, View
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.review.content.config import SceneConfig
from realsim.review.content.content import SceneContent
from realsim.review.placing.photograph import Photographs
from realsim.review.window import page_head
from refusals import refused
from reviewed_boxes import CAMERAS, MODELS, SCENE, boxes_session

TALL, FLAT = SCENE.objects


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> SceneContent:
    store = boxes_session(tmp_path_factory.mktemp("photograph") / "s", larger=4)
    return SceneContent.load(store, SceneConfig(most_points=2000, coarse_points=500,
                                                shown_points=500))  # fmt: skip


@pytest.fixture(scope="module")
def photographs(content: SceneContent) -> Photographs:
    return Photographs(content)


def shifted(o: ObjectPose, *by_mm: float) -> ObjectPose:
    return replace(o, T_world_obj=se3.from_translation(np.array(by_mm) / 1e3) @ o.T_world_obj)


def turned(o: ObjectPose, deg: float) -> ObjectPose:
    return replace(o, T_world_obj=o.T_world_obj @ se3.exp([0, 0, np.radians(deg), 0, 0, 0]))


def against(photographs: Photographs, *objects: ObjectPose, of: int = 3) -> list[float]:
    rows = photographs.strip(of, objects)["views"]
    found = [r["against"] for r in rows if r["against"] is not None]
    assert found == sorted(found, reverse=True) and len(found) >= 2
    return found


def decoded(jpeg: bytes) -> Rgb:
    return np.asarray(Image.open(io.BytesIO(jpeg)).convert("RGB"))


def test_nothing_speaks_against_right_poses(photographs: Photographs) -> None:
    for instance in (0, 3):
        assert against(photographs, TALL, FLAT, of=instance)[0] < 0.02
    assert [r["missing"] for r in photographs.strip(3, [TALL, FLAT])["views"]] == [[]] * 4


@pytest.mark.parametrize(
    "wrong",
    [shifted(FLAT, 3, 0, 0), shifted(FLAT, 0, -3, 0), shifted(FLAT, 0, 0, 3), turned(FLAT, 20),
     replace(FLAT, obj_id=9), shifted(FLAT, 40, 20, 0)],
)  # fmt: skip
def test_a_wrong_pose_of_three_millimetres_or_more_is_seen(
    photographs: Photographs, wrong: ObjectPose
) -> None:
    assert against(photographs, TALL, wrong)[0] > 0.12
    assert against(photographs, TALL, wrong, of=0)[0] < 0.06  # its neighbour is right


def test_what_has_no_model_is_circled_where_it_stands(
    photographs: Photographs, content: SceneContent
) -> None:
    circled = [r for r in photographs.strip(0, [TALL])["views"] if r["missing"]]
    assert len(circled) >= 3
    for r in circled:
        p = se3.transform(se3.invert(content.pose_of(r["view"])), FLAT.T_world_obj[None, :3, 3])
        u, v = camera.project(content.intrinsics, p)[0]
        (spot,) = r["missing"]
        assert np.hypot(spot["u"] - u, spot["v"] - v) < spot["radius"]


def test_outlines_lie_on_the_border_of_what_is_seen(
    photographs: Photographs, content: SceneContent
) -> None:
    placed = [PlacedMesh(o.instance, MODELS[o.obj_id].mesh, o.T_world_obj) for o in (TALL, FLAT)]
    labels = LabelRenderer(placed).render(content.intrinsics, content.pose_of(2))
    for drawn in photographs.outlines(2, [TALL, FLAT]):
        for line in drawn["seen"]:
            uv = np.reshape(line, (-1, 2))
            assert labels.visible(drawn["instance"])[uv[:, 1], uv[:, 0]].all()
    hidden = [sum(map(len, d["hidden"])) for d in photographs.outlines(2, [TALL, FLAT])]
    assert (min(labels.visible_fraction.values()) < 1) == (max(hidden) > 0)


def test_one_spot_is_the_same_point_in_all_views(
    photographs: Photographs, content: SceneContent
) -> None:
    corner = FLAT.T_world_obj[:3, 3] + [0.02, 0.01, 0.015]  # on its top
    pixels: dict[int, Any] = {}
    for view in range(4):
        p = se3.transform(se3.invert(content.pose_of(view)), corner[None])
        pixels[view] = camera.project(content.intrinsics, p)[0]
    spots = photographs.spot(0, tuple(pixels[0]), [TALL, FLAT])
    assert {s["view"] for s in spots} == {0, 1, 2, 3}
    for s in spots:
        np.testing.assert_allclose([s["u"], s["v"]], pixels[s["view"]], atol=1.5)
    assert photographs.spot(0, (-5.0, 3.0), []) == []


def test_layers_are_pictures_in_full_size(photographs: Photographs, content: SceneContent) -> None:
    wrong = [TALL, shifted(FLAT, 0, 0, 4)]
    kinds = ("photo", "depth", "render", "difference")
    photo, depth, render, difference = (decoded(photographs.picture(0, k, wrong)) for k in kinds)
    assert photo.shape == (480, 640, 3) == depth.shape == render.shape == difference.shape
    assert np.abs(photo.astype(int) - content.store.rgb(0)).mean() < 8  # a JPEG of it
    blue = (depth[..., 2].astype(int) - depth[..., 0] > 60).mean()
    right = decoded(photographs.picture(0, "depth", [TALL, FLAT]))
    assert blue > 0.005 > (right[..., 2].astype(int) - right[..., 0] > 60).mean()
    assert photographs.outlines(0, wrong) and not np.array_equal(render, photo)


def test_a_view_without_depth_says_nothing_and_one_that_is_not_there_is_refused(
    content: SceneContent, tmp_path: Path
) -> None:
    store = boxes_session(tmp_path / "s")
    store.add_view(View(index=9, T_world_cam=CAMERAS[0]), store.rgb(0))
    blind = Photographs(SceneContent.load(store, SceneConfig()))
    rows = {r["view"]: r for r in blind.strip(3, [TALL, FLAT])["views"]}
    assert rows[9]["against"] is None and rows[0]["against"] is not None
    refused("view 77", blind.outlines, 77, [TALL])


def test_views_are_told_as_they_are_compared_and_a_damaged_one_is_left_out(tmp_path: Path) -> None:
    store = boxes_session(tmp_path / "s")
    found = Photographs(SceneContent.load(store, SceneConfig()))
    path = store.path("depth/000002.png")
    whole = path.read_bytes()
    path.write_bytes(b"")
    steps = [found.strip(3, [TALL, FLAT], 0.0) for _ in range(4)]
    assert [s["compared"] for s in steps] == [1, 2, 4, 4] and steps[0]["of"] == 4
    assert sum(r["is_compared"] for r in steps[0]["views"]) == 1
    assert steps[3] == found.strip(3, [TALL, FLAT])
    assert [r["view"] for r in steps[3]["views"] if "000002.png" in r["trouble"]] == [2]
    path.write_bytes(whole)
    assert not any(r["trouble"] for r in found.strip(3, [TALL, FLAT])["views"])
    path.write_bytes(b"")
    known = Photographs(SceneContent.load(store, SceneConfig())).strip(None, [])
    assert [r["view"] for r in known["views"] if r["trouble"]] == [2] and known["of"] == 3


def test_a_slow_answer_is_asked_again_and_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_head, "SOON_S", 0.2)
    asked: list[str] = []
    gate = threading.Event()

    def ask(path: str) -> tuple[str, bytes]:
        asked.append(path)
        gate.wait(30)
        return "image/jpeg", path.encode()

    with page_head.answering(ask), local_pages.guarded(local_pages.Door()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        url = f"http://127.0.0.1:{server.get_port()}/photograph/0/x/photo/3"
        assert urllib.request.urlopen(url).read() == b'{"wait": true}'
        gate.set()
        answer = urllib.request.urlopen(url)
        assert answer.read() == b"/photograph/0/x/photo/3" and asked == ["/photograph/0/x/photo/3"]
        assert answer.headers["Content-Type"] == "image/jpeg"
    finally:
        server.stop()
