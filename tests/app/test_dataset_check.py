"""`realsim check` of a data set: what agrees ends with 0, what was spoiled is named, with 1."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from bop_scenes import edit
from realsim.app.check.dataset import checked_scenes
from typed_commands import complained, finished, invoked
from upgradable_datasets import bop_dataset, graspnet_dataset

SCENE = "test/000001"


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bop_dataset(tmp_path_factory.mktemp("check") / "dataset")


def moved(root: Path, offset_mm: tuple[float, float, float]) -> None:
    def move(rows: dict) -> None:
        rows["3"][0]["cam_t_m2c"] = np.add(rows["3"][0]["cam_t_m2c"], offset_mm).tolist()

    edit(root / SCENE / "scene_gt.json", move)


def swapped_masks(root: Path) -> None:
    for kind in ("mask", "mask_visib"):
        a, b = (root / SCENE / f"{kind}/000003_00000{k}.png" for k in (0, 1))
        a.rename(a.with_suffix(".tmp"))
        b.rename(a)
        a.with_suffix(".tmp").rename(b)


def eaten_mask(root: Path) -> None:
    path = root / SCENE / "mask_visib/000003_000000.png"
    mask = cv2.imread(str(path), 0)
    mask[:, np.flatnonzero(mask.any(0))[:20]] = 0
    cv2.imwrite(str(path), mask)


def wrong_counts(root: Path) -> None:
    """Counts that no mask has."""
    rows = [
        {"bbox_obj": [1, 1, 5, 5], "bbox_visib": [1, 1, 5, 5], "px_count_all": 77,
         "px_count_valid": 77, "px_count_visib": 77, "visib_fract": 1.0}
    ] * 2  # fmt: skip
    (root / SCENE / "scene_gt_info.json").write_text(json.dumps({"3": rows}))


SPOILED: dict[str, tuple[Callable[[Path], None], str]] = {
    "pose to the side": (lambda r: moved(r, (8.0, 0.0, 0.0)), "mask has the IoU"),
    "pose too far": (lambda r: moved(r, (0.0, 0.0, 40.0)), "from where its pose puts it"),
    "swapped masks": (swapped_masks, "mask has the IoU 0.00"),
    "eaten mask": (eaten_mask, "mask_visib has the IoU"),
    "wrong counts": (wrong_counts, "px_count_visib"),
}


def test_exact_labels_agree(pristine: Path) -> None:
    assert "1 of 1 scenes agree" in finished("check", pristine).output
    (found,) = checked_scenes(pristine)
    assert [o.name for o in found.objects] == ["box", "wedge"]
    for o in found.objects:
        # Masks and poses are exact; the table, which hides nothing here, is in neither.
        assert o.mask_iou == 1.0 and o.visible_iou == 1.0
        assert abs(o.depth_mm) < 0.1 and o.hidden == 0.0  # 0.1 mm is a count of depth


@pytest.mark.parametrize("case", SPOILED)
def test_what_was_spoiled_is_named(case: str, pristine: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(pristine, tmp_path / "dataset"))
    spoil, told = SPOILED[case]
    spoil(root)
    result = invoked("check", root)
    assert result.exit_code == 1, result.output
    assert told in " ".join(result.output.split())


def test_a_graspnet_tree_agrees_up_to_its_four_decimals(tmp_path: Path) -> None:
    root = graspnet_dataset(tmp_path / "dataset")
    finished("check", root)
    (found,) = checked_scenes(root)
    for o in found.objects:
        assert o.mask_iou is None, "GraspNet has no whole silhouettes"
        assert o.visible_iou is not None and o.visible_iou > 0.97
        assert o.depth_mm is not None and abs(o.depth_mm) < 1.0


def test_a_data_set_is_not_repaired(pristine: Path) -> None:
    assert "only sessions are repaired" in complained("check", pristine, "--repair")
