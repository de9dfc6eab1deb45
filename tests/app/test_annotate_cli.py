"""`realsim annotate`: what it tells, draws and refuses."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from realsim import images
from realsim.app.annotate.cli import annotate_command
from realsim.app.annotate.page import PAGE_FILE
from realsim.app.annotate.run import SHEET_FILE, sheet_views
from realsim.app.register.files import write_result
from realsim.errors import InputError
from realsim.store import SessionStore, load_scene, save_scene
from realsim.store.lock import only_run_in
from registered_sessions import models_of, registered_by_hand, table_session

MODELS = models_of()


@pytest.fixture
def store(tmp_path: Path) -> SessionStore:
    """A registered session of four views."""
    store = table_session(tmp_path / "s", views=4)
    write_result(store, registered_by_hand(store), MODELS, {})
    return SessionStore.open(store.folder)


def run(store: SessionStore, *options: str) -> Result:
    return CliRunner().invoke(
        annotate_command, [str(store.folder), "--quiet", *options], catch_exceptions=False
    )


def test_it_tells_of_every_object_and_draws_the_frames(store: SessionStore) -> None:
    result = run(store, "--maps", "all", "--workers", "2")
    assert result.exit_code == 0
    assert "4 views annotated (0 still held)" in result.output
    for model in MODELS.values():
        assert model.name in result.output
    assert images.read_rgb(store.path(SHEET_FILE)).shape[0] > 100
    for name in ("instance", "depth", "coordinates", "normals"):
        assert len(list(store.path(f"labels/{name}").iterdir())) == 4
    assert "4 views annotated (4 still held)" in run(store, "--maps", "all").output


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
    off = run(store, "--no-depth-check").output
    assert "occluder" not in off and "not in the scene" not in off


def test_an_unknown_map_is_named(store: SessionStore) -> None:
    with pytest.raises(InputError, match="no map 'colour'"):
        run(store, "--maps", "colour")
    assert not store.has("scene_gt_coco.json")


def test_the_sheet_shows_flagged_frames_first_and_others_too() -> None:
    views = list(range(100))
    shown = sheet_views(views, [50, 60, 70, 80, 90])
    assert shown[:4] == [50, 60, 70, 80] and len(shown) == 8 and len(set(shown)) == 8
    assert sheet_views([3, 4], [4]) == [4, 3]
    assert sheet_views([3, 4], [3, 4]) == [3, 4]
    assert sheet_views([], []) == []


def page_of(store: SessionStore) -> str:
    return store.path(PAGE_FILE).read_text("utf-8")


def test_the_page_shows_photographs_maps_objects_and_the_registration(store: SessionStore) -> None:
    told = run(store, "--maps", "all").output
    assert str(store.path(PAGE_FILE)) in told.replace("\n", "")
    page = page_of(store)
    titles = re.findall(r"<h2>(.*?)</h2>", page)
    assert titles == [
        "Photographs and labels", "Objects", "Maps", "Before and after registration"
    ]  # fmt: skip
    layers = re.findall(r'data-layer="(.*?)"', page)
    assert set(layers) == {"photo", "instances", "exact depth", "object coordinates", "normals"}
    assert all(m.name in page for m in MODELS.values())
    assert "http" not in re.sub(r"http://www\.w3\.org\S*", "", page)  # nothing is fetched
    run(store, "--maps", "none")
    assert "Maps" not in re.findall(r"<h2>(.*?)</h2>", page_of(store))


def captions_of(store: SessionStore) -> list[str]:
    return re.findall(r'class="view" data-name="(.*?)"', page_of(store))


def test_a_flagged_frame_comes_first(store: SessionStore) -> None:
    index = store.session.views[2].index
    depth = store.depth_m(index)
    store.write_image(f"depth/{index:06d}.png", images.depth_counts(0.6 * depth, 1e-4))
    run(store)
    assert captions_of(store)[0].startswith(f"view {index}: look here")
    assert not any("look here" in c for c in captions_of(store)[1:4])


def test_an_object_out_of_sight_is_named_under_the_picture(store: SessionStore) -> None:
    scene = load_scene(store)
    away = scene.objects[0].T_world_obj.copy()
    away[2, 3] += 5.0
    gone = replace(scene.objects[0], T_world_obj=away)
    save_scene(store, replace(scene, objects=(gone, scene.objects[1])))
    assert "nan" not in run(store).output  # agreement of what nobody saw
    name = MODELS[gone.obj_id].name
    assert all(f"(not visible: {name})" in c for c in captions_of(store)[:4])


@pytest.mark.parametrize("what", ["none", "rejected"])
def test_without_an_object_the_page_and_the_sheet_are_still_made(
    store: SessionStore, what: str
) -> None:
    scene = load_scene(store)
    rejected = tuple(replace(o, verdict="rejected") for o in scene.objects)
    save_scene(store, replace(scene, objects=() if what == "none" else rejected))
    result = run(store, "--maps", "all")
    assert result.exit_code == 0 and "4 views show no object" in result.output
    assert "4 views show no object" in page_of(store)
    assert images.read_rgb(store.path(SHEET_FILE)).shape[0] > 100


@pytest.mark.parametrize(
    "path",
    ["mask_visib/000001_000000.png", "labels/instance/000001.png", "annotations/000001.json"],
)
def test_a_damaged_result_is_made_again(store: SessionStore, path: str) -> None:
    run(store)
    whole = store.path(path).read_bytes()
    store.path(path).write_bytes(whole[: len(whole) // 2])
    again = run(SessionStore.open(store.folder)).output
    assert "4 views annotated (3 still held)" in again
    assert store.path(path).read_bytes() == whole


def test_two_runs_at_once_do_not_mix(store: SessionStore) -> None:
    with only_run_in(store.folder), pytest.raises(InputError, match="another run is working"):
        run(store)
    assert not store.has("scene_gt_coco.json")
    assert run(store).exit_code == 0


def test_a_texture_that_is_missing_is_told_once_and_not_as_a_warning(
    store: SessionStore, capfd: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder
) -> None:
    file = next(store.path("models").glob("*.ply"))
    head, rest = file.read_bytes().split(b"\n", 1)
    file.write_bytes(head + b"\n" + rest.replace(
        b"element vertex", b"comment TextureFile gone.png\nelement vertex", 1))  # fmt: skip
    result = run(store)
    said = "".join(capfd.readouterr()) + result.output + (result.stderr or "")
    assert result.exit_code == 0
    assert not [w for w in recwarn if "gone.png" in str(w.message)]
    assert said.replace("\n", "").count("gone.png") in (1, 2)  # CliRunner may mix both streams
