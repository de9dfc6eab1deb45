"""Every kind of bad input ends with one paragraph that names it, exit code 2, nothing written."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from bop_scenes import edit
from typed_commands import complained
from upgradable_datasets import bop_dataset


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bop_dataset(tmp_path_factory.mktemp("bop") / "dataset")


def upgrade(dataset: Path, out: Path, *more: str) -> str:
    """Return what `realsim upgrade` complained of."""
    return complained("upgrade", dataset, "--out", out, "--quiet", *more)


def scaled_models(root: Path, factor: float) -> None:
    import trimesh

    for file in (root / "models").glob("*.ply"):
        mesh = trimesh.load(file, process=False)
        mesh.apply_scale(factor)
        mesh.export(file)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def wrong_scale(d: dict) -> None:
    d["3"]["depth_scale"] = 1.0


def sheared(d: dict) -> None:
    d["3"][0]["cam_R_m2c"][0] *= 1.3


def in_metres(d: dict) -> None:
    for row in d["3"]:
        row["cam_t_m2c"] = [v / 1e3 for v in row["cam_t_m2c"]]


def unknown_object(d: dict) -> None:
    d["3"][0]["obj_id"] = 77


SCENE = "test/000001"
CASES: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing depth image": (lambda r: (r / SCENE / "depth/000003.png").unlink(), "depth"),
    "missing models": (lambda r: shutil.rmtree(r / "models"), "models"),
    "truncated depth": (lambda r: truncate(r / SCENE / "depth/000003.png"), "000003.png"),
    "broken json": (lambda r: truncate(r / SCENE / "scene_gt.json"), "scene_gt.json"),
    "mesh in metres": (lambda r: scaled_models(r, 1e-3), "obj_0000"),
    "wrong depth scale": (lambda r: edit(r / SCENE / "scene_camera.json", wrong_scale),
                          "depth_scale"),
    "sheared pose": (lambda r: edit(r / SCENE / "scene_gt.json", sheared), "not rigid"),
    "poses in metres": (lambda r: edit(r / SCENE / "scene_gt.json", in_metres), "metres"),
    "object without mesh": (lambda r: edit(r / SCENE / "scene_gt.json", unknown_object), "77"),
    "unknown start": (lambda r: None, "keyframe_poses"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_named_and_nothing_is_written(
    case: str, pristine: Path, tmp_path: Path
) -> None:
    root = Path(shutil.copytree(pristine, tmp_path / "dataset"))
    spoil, told = CASES[case]
    spoil(root)
    more = ["--start", "nobody"] if case == "unknown start" else []
    text = upgrade(root, tmp_path / "out", *more)
    assert told in text
    assert "\n\n" not in text.strip(), "one paragraph"
    assert not (tmp_path / "out").exists()


def test_unknown_scene_is_named(pristine: Path, tmp_path: Path) -> None:
    text = upgrade(pristine, tmp_path / "out", "--only-scenes", "9")
    assert "scene 9" in text and "1" in text
    assert not (tmp_path / "out").exists()


def test_a_session_is_no_data_set(pristine: Path, tmp_path: Path) -> None:
    shutil.copytree(pristine / SCENE, tmp_path / "demo/session")
    (tmp_path / "demo/session/session.json").write_text("{}")
    text = upgrade(tmp_path / "demo", tmp_path / "out")
    assert "is a session of realsim" in text and "SPLIT/000001" in text


def test_a_place_that_is_no_place_for_results_is_named(pristine: Path, tmp_path: Path) -> None:
    assert "only read" in upgrade(pristine, pristine / "upgraded")
    assert not (pristine / "upgraded").exists()
    (tmp_path / "notes.txt").write_text("mine")
    assert "not empty" in upgrade(pristine, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    assert "/proc/upgraded" in upgrade(pristine, Path("/proc/upgraded"))
