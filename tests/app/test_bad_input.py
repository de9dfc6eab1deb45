"""Every kind of bad input ends with one paragraph that names it, exit code 2, nothing written."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from realsim.app import cli
from realsim.app.annotate.current import annotate_session
from realsim.app.console import Console
from realsim.app.register.run import register_session
from realsim.app.school.run import school_session
from realsim.errors import RealsimError
from realsim.formats.bop.models import save_models
from realsim.geometry import se3
from realsim.geometry.mesh import load_mesh, save_ply
from realsim.geometry.parts import part
from realsim.records import CameraIntrinsics, Mesh
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.review.reviewed_session import ReviewedSession
from realsim.store import SessionStore

CAMERA = CameraIntrinsics(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
T_WORLD_CAM = se3.look_at([0.0, -0.45, 0.45], [0.0, 0.0, 0.02])


def slab() -> Mesh:
    x, y = 0.5, 0.5
    v = [[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]
    return Mesh(vertices=np.array(v, dtype=float), faces=np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A BOP dataset of one scene and one image: two parts on a table."""
    root = tmp_path_factory.mktemp("bop") / "dataset"
    scene = root / "test/000001"
    models = {m.obj_id: m for m in (part("box"), part("wedge"))}
    placed = [
        PlacedMesh(k, m.mesh, se3.from_translation([0.12 * k - 0.06, 0, -m.mesh.bounds[0, 2]]))
        for k, m in enumerate(models.values())
    ]
    labels = LabelRenderer([*placed, PlacedMesh(-1, slab(), np.eye(4))]).render(CAMERA, T_WORLD_CAM)
    for name in ("rgb", "depth"):
        (scene / name).mkdir(parents=True)
    grey = np.clip(255 * (1 - labels.depth_m), 0, 255).astype(np.uint8)
    cv2.imwrite(str(scene / "rgb/000003.png"), np.repeat(grey[..., None], 3, -1))
    cv2.imwrite(str(scene / "depth/000003.png"), np.round(labels.depth_m * 1e4).astype(np.uint16))
    camera = {"cam_K": CAMERA.K.ravel().tolist(), "depth_scale": 0.1}
    (scene / "scene_camera.json").write_text(json.dumps({"3": camera}))
    rows = []
    for p, obj_id in zip(placed, models, strict=True):
        T = se3.invert(T_WORLD_CAM) @ p.T_world_obj
        rows.append(
            {
                "obj_id": obj_id,
                "cam_R_m2c": T[:3, :3].ravel().tolist(),
                "cam_t_m2c": (1e3 * T[:3, 3]).tolist(),
            }
        )
    (scene / "scene_gt.json").write_text(json.dumps({"3": rows}))
    save_models(root / "models", models)
    return root


def upgrade(dataset: Path, out: Path, *more: str) -> tuple[int, str]:
    """Run `realsim upgrade` in this process; return the exit code of main() and the text."""
    done = CliRunner().invoke(
        cli.commands, ["upgrade", str(dataset), "--out", str(out), "--quiet", *more]
    )
    if done.exception is not None and isinstance(done.exception, RealsimError):
        return 2, str(done.exception)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, done.output


def edit(path: Path, change: Callable[[dict], None]) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def scaled_models(root: Path, factor: float) -> None:
    import trimesh

    for file in (root / "models").glob("*.ply"):
        mesh = trimesh.load(file, process=False)
        mesh.apply_scale(factor)
        mesh.export(file)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def no_scale(d: dict) -> None:
    del d["3"]["depth_scale"]


def wrong_scale(d: dict) -> None:
    d["3"]["depth_scale"] = 1.0


def sheared(d: dict) -> None:
    d["3"][0]["cam_R_m2c"][0] *= 1.3


def in_metres(d: dict) -> None:
    for row in d["3"]:
        row["cam_t_m2c"] = [v / 1e3 for v in row["cam_t_m2c"]]


def unknown_object(d: dict) -> None:
    d["3"][0]["obj_id"] = 77


def nobody(d: dict) -> None:
    d["3"] = []


SCENE = "test/000001"
CASES: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing depth image": (lambda r: (r / SCENE / "depth/000003.png").unlink(), "depth"),
    "missing colour image": (lambda r: (r / SCENE / "rgb/000003.png").unlink(), "000001"),
    "missing models": (lambda r: shutil.rmtree(r / "models"), "models"),
    "truncated depth": (lambda r: truncate(r / SCENE / "depth/000003.png"), "000003.png"),
    "truncated colour": (lambda r: truncate(r / SCENE / "rgb/000003.png"), "000003.png"),
    "broken json": (lambda r: truncate(r / SCENE / "scene_gt.json"), "scene_gt.json"),
    "mesh in metres": (lambda r: scaled_models(r, 1e-3), "obj_0000"),
    "mesh in micrometres": (lambda r: scaled_models(r, 1e3), "obj_0000"),
    "no depth scale": (lambda r: edit(r / SCENE / "scene_camera.json", no_scale), "depth_scale"),
    "wrong depth scale": (lambda r: edit(r / SCENE / "scene_camera.json", wrong_scale),
                          "depth_scale"),
    "sheared pose": (lambda r: edit(r / SCENE / "scene_gt.json", sheared), "not rigid"),
    "poses in metres": (lambda r: edit(r / SCENE / "scene_gt.json", in_metres), "metres"),
    "object without mesh": (lambda r: edit(r / SCENE / "scene_gt.json", unknown_object), "77"),
    "no annotated object": (lambda r: edit(r / SCENE / "scene_gt.json", nobody), "no annotated"),
    "unknown start": (lambda r: None, "keyframe_poses"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_named_and_nothing_is_written(
    case: str, pristine: Path, tmp_path: Path
) -> None:
    root = tmp_path / "dataset"
    shutil.copytree(pristine, root)
    spoil, told = CASES[case]
    spoil(root)
    more = ["--start", "nobody"] if case == "unknown start" else []
    code, text = upgrade(root, tmp_path / "out", *more)
    assert code == 2, text
    assert told in text
    assert "\n\n" not in text.strip(), "one paragraph"
    assert not (tmp_path / "out").exists()


def test_unknown_scene_is_named(pristine: Path, tmp_path: Path) -> None:
    code, text = upgrade(pristine, tmp_path / "out", "--scenes", "9")
    assert code == 2 and "scene 9" in text and "1" in text
    assert not (tmp_path / "out").exists()


def test_output_inside_the_dataset_is_refused(pristine: Path) -> None:
    code, text = upgrade(pristine, pristine / "upgraded")
    assert code == 2 and "only read" in text
    assert not (pristine / "upgraded").exists()


def test_somebody_elses_folder_is_left_alone(pristine: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    code, text = upgrade(pristine, tmp_path)
    assert code == 2 and "not empty" in text
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_unwritable_output_is_named(pristine: Path) -> None:
    code, text = upgrade(pristine, Path("/proc/upgraded"))
    assert code == 2 and "/proc/upgraded" in text


@pytest.mark.slow
def test_the_pristine_dataset_is_upgraded(pristine: Path, tmp_path: Path) -> None:
    code, text = upgrade(pristine, tmp_path / "out", "--grasps", "4", "--workers", "1")
    assert code == 0, text
    scene = tmp_path / "out/test/000001"
    gt = json.loads((scene / "scene_gt.json").read_text())["3"]
    given = json.loads((pristine / "test/000001/scene_gt.json").read_text())["3"]
    for mine, theirs in zip(gt, given, strict=True):
        assert mine["obj_id"] == theirs["obj_id"]
        # Noise-free depth, started at the truth: the answer stays there.
        np.testing.assert_allclose(mine["cam_t_m2c"], theirs["cam_t_m2c"], atol=0.5)
    for name in ("mask", "mask_visib", "scene_gt_info.json", "scene_gt_coco.json", "grasps"):
        assert (scene / name).exists(), name
    assert list((scene / "reports").glob("overlay_*.png"))
    camera = json.loads((tmp_path / "out/camera.json").read_text())
    assert camera["fx"] == 300.0 and camera["depth_scale"] == pytest.approx(0.1)
    targets = json.loads((tmp_path / "out/test_targets_bop19.json").read_text())
    assert targets[0] == {"scene_id": 1, "im_id": 3, "obj_id": 1, "inst_count": 1}
    store = SessionStore.open(scene)
    assert store.verify() == []
    _reviewed_session_follows_the_reviewer(store)
    _changed_mesh_is_registered_anew(store)


def _reviewed_session_follows_the_reviewer(store: SessionStore) -> None:
    """A person's rejection takes the object out of the school and out of every label."""
    console = Console(quiet=True)
    reviewed = ReviewedSession(store)
    reviewed.decide("reject", reviewed.standing.scene.object(0), "anna", comment="wrong side up")
    sets = school_session(store, console, grasps_per_object=4, workers=1)
    assert [s.instance for s in sets] == [1]
    assert [p.name for p in (store.folder / "grasps").glob("*.npz")] == ["000001_obj000008.npz"]
    annotate_session(store, console)
    assert [row["obj_id"] for row in store.read_json("scene_gt.json")["3"]] == [8]
    assert len(list((store.folder / "mask").glob("*.png"))) == 1
    assert store.verify() == []


def _changed_mesh_is_registered_anew(store: SessionStore) -> None:
    """The same inputs are not computed again; another mesh under the same name is."""
    console = Console(quiet=True)
    noted = store.path("stages/register.json").read_bytes()
    register_session(store, console)
    assert store.path("stages/register.json").read_bytes() == noted
    file = store.folder / "models/obj_000008.ply"
    mesh = load_mesh(file, "mm")
    save_ply(file, Mesh(vertices=mesh.vertices * 1.0001, faces=mesh.faces), "mm")
    register_session(store, console)
    assert store.path("stages/register.json").read_bytes() != noted
