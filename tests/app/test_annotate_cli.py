"""`realsim annotate`: what it tells, draws and refuses."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from realsim.app.annotate import SHEET_FILE, sheet_views
from realsim.app.annotate_cli import annotate_command
from realsim.app.register_files import write_result
from realsim.errors import InputError
from realsim.formats import images
from realsim.store import SessionStore
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
