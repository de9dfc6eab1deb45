"""`realsim annotate`: what it tells, draws and refuses."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

from realsim import images
from realsim.app.annotate.page import PAGE_FILE
from realsim.app.annotate.run import SHEET_FILE
from realsim.geometry import se3
from realsim.store import SessionStore, load_scene, save_scene
from realsim.store.atomic import only_run_in
from registered_sessions import models_of
from shared_sessions import copy_of
from typed_commands import finished, refused

MODELS = models_of()


@pytest.fixture
def store(registered_few: Path, tmp_path: Path) -> SessionStore:
    return SessionStore.open(copy_of(registered_few, tmp_path / "s"))


def run(store: SessionStore, *options: str) -> Result:
    return finished("annotate", store.folder, "--quiet", *options)


def page_of(store: SessionStore) -> str:
    return store.path(PAGE_FILE).read_text("utf-8")


def test_it_tells_of_every_object_and_draws_the_frames(store: SessionStore) -> None:
    said = run(store, "--maps", "all").output
    for words in ("4 views annotated (0 still held)", *(m.name for m in MODELS.values())):
        assert words in said
    assert images.read_rgb(store.path(SHEET_FILE)).shape[0] > 100
    for name in ("instance", "depth", "coordinates", "normals"):
        assert len(list(store.path(f"labels/{name}").iterdir())) == 4
    page = store.path(PAGE_FILE).read_bytes()
    told = run(store, "--maps", "all").output
    assert "4 views annotated (4 still held)" in told
    assert store.path(PAGE_FILE).read_bytes() == page
    assert str(store.path(PAGE_FILE)) in told.replace("\n", "")
    text = page_of(store)
    titles = ["Photographs and labels", "Objects", "Maps", "Before and after registration"]
    assert re.findall(r"<h2>(.*?)</h2>", text) == titles
    layers = re.findall(r'data-layer="(.*?)"', text)
    assert set(layers) == {"photo", "instances", "exact depth", "object coordinates", "normals"}
    assert all(m.name in text for m in MODELS.values())
    assert "http" not in re.sub(r"http://www\.w3\.org\S*", "", text)  # nothing is fetched


def test_a_hand_before_an_object_is_told_and_can_be_switched_off(store: SessionStore) -> None:
    index = store.session.views[1].index
    depth = store.depth_m(index)
    rows, columns = depth.shape
    block = (slice(rows // 3, 2 * rows // 3), slice(columns // 3, columns))
    depth[block] = np.where(depth[block] > 0, 0.6 * depth[block], 0)
    store.write_image(f"depth/{index:06d}.png", images.depth_counts(depth, 1e-4))
    told = run(store).output
    assert f"view {index}: " in told
    assert "is hidden by something that is not in the scene" in told or "occluder" in told
    assert captions_of(store)[0].startswith(f"view {index}: look here")
    assert not any("look here" in c for c in captions_of(store)[1:4])
    off = run(store, "--no-depth-check").output
    assert "occluder" not in off and "not in the scene" not in off


def test_an_unknown_map_is_named(store: SessionStore) -> None:
    assert "no map 'colour'" in refused("annotate", store.folder, "--maps", "colour")
    assert not store.has("scene_gt_coco.json")


def captions_of(store: SessionStore) -> list[str]:
    return re.findall(r'class="view" data-name="(.*?)"', page_of(store))


def test_an_object_out_of_sight_is_named_under_the_picture(store: SessionStore) -> None:
    scene = load_scene(store)
    first, second = scene.objects
    gone = replace(first, T_world_obj=se3.from_translation([0, 0, 5.0]) @ first.T_world_obj)
    save_scene(store, replace(scene, objects=(gone, second)))
    assert "nan" not in run(store).output  # agreement of what nobody saw
    name = MODELS[gone.obj_id].name
    assert all(f"(not visible: {name})" in c for c in captions_of(store)[:4])


def test_without_an_object_the_page_and_the_sheet_are_still_made(store: SessionStore) -> None:
    scene = load_scene(store)
    rejected = tuple(replace(o, verdict="rejected") for o in scene.objects)
    save_scene(store, replace(scene, objects=rejected))
    assert "4 views show no object" in run(store, "--maps", "all").output
    assert "4 views show no object" in page_of(store)
    assert images.read_rgb(store.path(SHEET_FILE)).shape[0] > 100


def test_a_damaged_result_is_made_again(store: SessionStore) -> None:
    run(store)
    paths = ("mask_visib/000000_000000.png", "labels/instance/000001.png",
             "annotations/000003.json")  # fmt: skip
    whole = {path: store.path(path).read_bytes() for path in paths}
    for path, data in whole.items():
        store.path(path).write_bytes(data[: len(data) // 2])
    again = run(SessionStore.open(store.folder)).output
    assert "4 views annotated (1 still held)" in again
    assert {path: store.path(path).read_bytes() for path in paths} == whole


def test_two_runs_at_once_do_not_mix(store: SessionStore) -> None:
    with only_run_in(store.folder):
        assert "another run is working" in refused("annotate", store.folder)
    assert not store.has("scene_gt_coco.json")


def test_a_texture_that_is_missing_is_told_once_and_not_as_a_warning(
    store: SessionStore, capfd: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder
) -> None:
    file = next(store.path("models").glob("*.ply"))
    head, rest = file.read_bytes().split(b"\n", 1)
    file.unlink()  # it is linked to that of the other tests
    file.write_bytes(head + b"\n" + rest.replace(
        b"element vertex", b"comment TextureFile gone.png\nelement vertex", 1))  # fmt: skip
    result = run(store)
    said = "".join(capfd.readouterr()) + result.output + (result.stderr or "")
    assert not [w for w in recwarn if "gone.png" in str(w.message)]
    assert said.replace("\n", "").count("gone.png") in (1, 2)  # click may mix both streams
