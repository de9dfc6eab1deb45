"""`realsim scan`: what a user sees, which exit code ends it, and what is on the disk afterwards.

`realsim scan sfm` on photographs that cannot be used: each one is named.

`realsim scan sfm` to the end with the real COLMAP: the robot's metre.
"""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import refusals
from begun_sessions import begun
from realsim.app.console import Console
from realsim.app.scan.sfm.run import SfmRequest, run_scan_sfm
from realsim.errors import RealsimError
from realsim.formats.bop.models import load_models, save_models
from realsim.geometry import se3
from realsim.geometry.mesh import save_ply
from realsim.geometry.parts import part
from realsim.images import png_bytes
from realsim.models.convex_worker import ConvexConfig
from realsim.models.library import ModelLibrary
from realsim.models.library_prepare import PrepareConfig
from realsim.models.model_records import ScaleNote
from realsim.records import CameraIntrinsics, View
from realsim.store import SessionStore
from typed_commands import realsim


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Mesh files of every kind."""
    folder = tmp_path_factory.mktemp("meshes")
    wedge = part("wedge").mesh
    save_ply(folder / "wedge.ply", wedge, "mm")
    save_ply(folder / "box.ply", part("box").mesh, "mm")
    save_ply(folder / "open.ply", replace(wedge, faces=wedge.faces[:-2]), "mm")
    save_ply(folder / "wrong side.ply", replace(wedge, faces=wedge.faces[:, ::-1]), "mm")
    flat = replace(wedge, vertices=wedge.vertices * [1, 1, 0])
    save_ply(folder / "flat.ply", flat, "mm")
    (folder / "broken.obj").write_text("v 0 0 zero\nf 1 2 3\n")
    (folder / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n0 0 0\n"
    )
    return folder


@pytest.fixture(scope="module")
def imported(
    meshes: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, "subprocess.CompletedProcess[str]"]:
    """A library with the wedge, and what its import said."""
    library = tmp_path_factory.mktemp("imported") / "models"
    words = ("--unit", "mm", "--mass", 0.2, "--no-parts", "--quiet", "--library", library)
    return library, realsim("scan", "import", meshes / "wedge.ply", *words)


def run(*words: object) -> tuple[int, str, str]:
    """Run a command line; return its exit code and what it printed on stdout and stderr."""
    done = realsim(*words)
    return done.returncode, " ".join(done.stdout.split()), " ".join(done.stderr.split())


def scan_import(meshes: Path, library: Path, *words: object):
    files = [meshes / w if isinstance(w, str) and "." in w and w[0] != "-" else w for w in words]
    return run("scan", "import", *files, "--library", library, "--no-parts", "--quiet")


def test_a_mesh_is_imported_listed_shown_and_checked(imported, tmp_path: Path):
    library = Path(shutil.copytree(imported[0], tmp_path / "models"))
    out = " ".join(imported[1].stdout.split())
    assert imported[1].returncode == 0
    for said in ("wedge (object 1): accepted", "200 (weighed)", "watertight", "principal inertia"):
        assert said in out
    assert (library / "pictures/wedge.png").is_file()
    model = load_models(library)[1]
    assert np.allclose(model.mesh.extent, part("wedge").mesh.extent, rtol=1e-6)
    code, out, _ = run("scan", "list", library)
    assert code == 0 and "wedge" in out and "accepted" in out and "200" in out
    (library / "pictures/wedge.png").unlink()
    code, out, _ = run("scan", "show", library, "wedge")
    assert code == 0 and "wedge.png" in out and (library / "pictures/wedge.png").is_file()
    assert run("scan", "check", library)[0] == 0
    (library / "obj_000001.ply").write_bytes(b"gone")
    code, out, _ = run("scan", "check", library, "--json")
    assert code == 1 and json.loads(out)["findings"][0]["kind"] == "changed"


def test_a_mesh_without_scale_waits_for_one(meshes: Path, tmp_path: Path):
    library = tmp_path / "m"
    assert "Is that so?" in scan_import(meshes, tmp_path / "c", "box.ply", "--unit", "cm")[1]
    code, out, _ = scan_import(meshes, library, "wedge.ply", "--unit", "none")
    assert code == 0 and "realsim scan scale wedge SESSION" in out
    assert json.loads((library / "models_info.json").read_text()) == {}
    assert sorted(p.name for p in (library / "unscaled/wedge").iterdir()) == [
        "mesh.ply", "picture.png", "report.json",
    ]  # fmt: skip
    listed = run("scan", "list", library)[1]
    assert "0 models and 1 unscaled mesh in" in listed and "no scale yet" in listed
    assert "accepted" not in listed and "accepted" not in out
    assert f"kept as 'wedge', in {library / 'unscaled/wedge'}" in out
    assert run("scan", "show", library, "wedge")[0] == 0


@pytest.mark.slow
def test_a_scaled_model_is_one_row_with_the_mark_of_its_source(meshes: Path, tmp_path: Path):
    library = tmp_path / "m"
    scan_import(meshes, library, "wedge.ply", "--unit", "none")
    note = ScaleNote(scale=1e-3, sigma_percent=0.3, verdict="doubtful", reasons=("two scales.",))
    ModelLibrary.open(library).promote("wedge", note, PrepareConfig(with_parts=False))
    scan_import(meshes, library, "box.ply", "--unit", "mm")
    scan_import(meshes, library, "box.ply", "--unit", "none")
    listed = run("scan", "list", library)[1]
    # The box has its scale from its file: the box without one is another mesh.
    assert "2 models and 1 unscaled mesh in" in listed and "wedge (*)" in listed
    assert "(*) 1 kept without scale" in listed and "box (*)" not in listed
    assert f"wedge is doubtful: `realsim scan show {library} wedge` says why" in listed
    assert "two scales" in run("scan", "show", library, "wedge")[1]
    assert "2 models and 2 unscaled meshes in" in run("scan", "check", library)[1]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["wedge.ply"], "does not state its unit"),
        (["wedge.ply", "--unit", "m"], "as mm"),
        (["box.ply", "--unit", "inch"], "4 mm to 1.7 m is accepted"),
        (["broken.obj", "--unit", "mm"], "mesh: it seems to be cut off or damaged. Copy"),
        (["points.ply", "--unit", "mm"], "no triangles"),
        (["flat.ply", "--unit", "mm"], "flat"),
        (["wedge.ply", "--unit", "mm", "--mass", "nan"], "--mass is nan"),
        (["wedge.ply", "--unit", "mm", "--mass", "1", "--density", "1"], "both given"),
        (["wedge.ply", "--unit", "mm", "--name", "a/b"], "cannot be the name"),
        (["wedge.ply", "--unit", "none", "--mass", "1"], "metric scale"),
        (["wedge.ply", "box.ply", "--unit", "mm", "--name", "x"], "of one model"),
    ],
)
def test_bad_input_is_named_and_leaves_nothing(meshes, tmp_path, words, said: str):
    code, out, err = scan_import(meshes, tmp_path / "m", *words)
    assert code == 2 and said in err and out == ""
    assert not (tmp_path / "m/models_info.json").exists() or not load_entries(tmp_path / "m")


def load_entries(library: Path) -> list[str]:
    return [e.name for e in ModelLibrary.open(library).entries()]


def test_nothing_is_replaced_unasked(imported, meshes: Path, tmp_path: Path):
    library = Path(shutil.copytree(imported[0], tmp_path / "m"))
    before = (library / "obj_000001.ply").read_bytes()
    code, _, err = scan_import(meshes, library, "box.ply", "--unit", "mm", "--name", "wedge")
    assert code == 2 and "--overwrite" in err
    assert (library / "obj_000001.ply").read_bytes() == before
    words = ("box.ply", "--unit", "mm", "--name", "wedge", "--overwrite")
    assert scan_import(meshes, library, *words)[0] == 0
    assert load_entries(library) == ["wedge"]
    assert (library / "obj_000001.ply").read_bytes() != before
    for name, other in (("wedge", "a b"), ("box", "a_b")):
        shutil.copy(meshes / f"{name}.ply", tmp_path / f"{other}.ply")
    words = ("a b.ply", "a_b.ply", "--unit", "mm", "--overwrite")
    code, _, err = scan_import(tmp_path, tmp_path / "m", *words)
    assert code == 2 and "a_b.ply: not imported" in err and "a b.ply is. Import it by" in err


def test_a_bop_folder_is_completed(tmp_path: Path):
    save_models(tmp_path / "bop/models", {1: part("box"), 8: part("wedge")})
    code, out, _ = run("scan", "list", tmp_path / "bop/models")
    assert code == 0 and "scan complete" in out
    code, _, err = run("scan", "list", tmp_path / "bop")
    assert code == 2 and "Did you mean" in err
    words = ("wedge", "--mass", 0.1, "--quiet")
    code, out, _ = run("scan", "complete", tmp_path / "bop/models", *words)
    limit = f"up to {ConvexConfig().time_limit_s:g} s of CPU time"
    assert code == 0 and limit in out
    assert "1/1 wedge: symmetries" in out and "1 of 1 completed" in out
    code, out, _ = run("scan", "show", tmp_path / "bop/models", "wedge")
    assert code == 0 and "100 (weighed)" in out


@pytest.mark.slow
def test_what_a_person_should_look_at_ends_with_1(meshes: Path, tmp_path: Path):
    code, out, _ = scan_import(meshes, tmp_path / "m", "open.ply", "--unit", "mm")
    assert code == 1 and "open (object 1): doubtful" in out and "LOOK: open:" in out
    code, out, err = scan_import(meshes, tmp_path / "m", "wrong side.ply", "flat.ply",
                                 "--unit", "mm")  # fmt: skip
    assert code == 2 and "wrong_side (object 2): accepted" in out and "repaired:" in out
    # One bad mesh does not keep the others out.
    assert "flat.ply: not imported: " in err and "[red]" not in err and "unusable" in out
    assert load_entries(tmp_path / "m") == ["open", "wrong_side"]


def put(folder: Path, sizes: list[tuple[int, int]]) -> Path:
    """Write even grey pictures (height, width)."""
    folder.mkdir()
    for k, size in enumerate(sizes):
        (folder / f"{k:03d}.png").write_bytes(png_bytes(np.full((*size, 3), 120, np.uint8)))
    return folder


def refused(folder: Path, **options: object) -> str:
    request = SfmRequest(images=folder, **options)  # pyright: ignore[reportArgumentType]
    return refusals.refused(".", run_scan_sfm, request, Console(quiet=True), error=RealsimError)


def test_bad_photographs_are_named(tmp_path: Path) -> None:
    assert "is not a folder" in refused(tmp_path / "missing")
    assert "holds no images" in refused(put(tmp_path / "empty", []))
    assert "2 photograph(s)" in refused(put(tmp_path / "two", [(48, 64)] * 2))
    told = refused(put(tmp_path / "sizes", [(48, 64), (48, 64), (64, 48)]))
    assert "2 of 64x48" in told and "1 of 48x64 (002.png)" in told
    torn = put(tmp_path / "torn", [(48, 64)] * 3)
    (torn / "001.png").write_bytes((torn / "001.png").read_bytes()[:60])
    assert "001.png" in refused(torn)


def test_bare_pictures_say_what_to_do(tmp_path: Path) -> None:
    told = refused(put(tmp_path / "bare", [(120, 160)] * 4))
    assert "no texture" in told and "newspaper" in told and "000.png (0)" in told


def test_poses_and_depth_of_a_plain_folder_are_refused(tmp_path: Path) -> None:
    folder = put(tmp_path / "plain", [(48, 64)] * 3)
    assert "plain folder" in refused(folder, poses="refined")
    assert "no depth images" in refused(folder, dense=True)


CAMERA = CameraIntrinsics(width=400, height=300, fx=330.0, fy=330.0, cx=199.5, cy=149.5)
VIEWS = 6
LEVELS_M = (0.0, 0.03)
"""Heights of the two printed squares; the upper one is smaller and lies in the middle."""
SIDES_M = (0.4, 0.14)


def print_of(seed: int, side_px: int) -> np.ndarray:
    """Return a square of random boxes of all sizes."""
    rng = np.random.default_rng(seed)
    image = np.full((side_px, side_px, 3), 200, np.uint8)
    for size in (100, 50, 25, 12):
        for _ in range(12 * (100 // size) ** 2):
            x, y = rng.integers(0, side_px, 2)
            w, h = rng.integers(size // 3 + 1, size + 1, 2)
            image[y : y + h, x : x + w] = rng.integers(10, 250, 3)
    return image


def photo(T_world_cam: np.ndarray) -> np.ndarray:
    """Return the picture of the two squares: each is seen through a homography."""
    import cv2

    T = se3.invert(T_world_cam)
    seen = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)
    for k, (z, side) in enumerate(zip(LEVELS_M, SIDES_M, strict=True)):
        texture = print_of(k, round(1500 * side))
        s = side / len(texture)
        plane = np.array([[s, 0, -side / 2], [0, s, -side / 2], [0, 0, z], [0, 0, 1]])
        H = CAMERA.K @ (T[:3] @ plane)
        size = (CAMERA.width, CAMERA.height)
        warped = cv2.warpPerspective(texture, H, size, flags=cv2.INTER_AREA)
        cover = cv2.warpPerspective(np.full(texture.shape[:2], 255, np.uint8), H, size)
        seen[cover > 127] = warped[cover > 127]
    return seen


def cameras(count: int = VIEWS) -> np.ndarray:
    """Return cameras (V, 4, 4) on an arc over the squares."""
    turn = np.linspace(0.0, 1.2, count)
    eyes = np.stack([0.2 * np.cos(turn), 0.2 * np.sin(turn), 0.30 + 0.04 * np.sin(5 * turn)], -1)
    return np.stack([se3.look_at(eye, np.zeros(3)) for eye in eyes])


def session(folder: Path, Ts: np.ndarray) -> SessionStore:
    store = begun(folder, CAMERA, {"plan_hash": "p" * 64})
    for k, T in enumerate(Ts):
        view = View(index=k, T_base_ee=T, joints=np.zeros(6), time_s=float(k))
        store.add_view(view, photo(T))
    store.set_cameras(CAMERA, dict(enumerate(Ts)))
    return store


def report(folder: Path, **options: object) -> dict[str, Any]:
    """Run the command; return its report."""
    run_scan_sfm(SfmRequest(images=folder, **options), Console(quiet=True))  # pyright: ignore[reportArgumentType]
    return json.loads((folder / "scans/sfm/sfm.json").read_text())


def read_cameras(folder: Path) -> np.ndarray:
    """T_world_cam (V, 4, 4) of the views that were found."""
    views = json.loads((folder / "scans/sfm/cameras.json").read_text())["views"]
    return np.array([v["T_world_cam"] for v in views])


@pytest.mark.slow
def test_free_mapping_has_the_robots_metre(tmp_path: Path) -> None:
    Ts = cameras()
    session(tmp_path / "s", Ts)
    told = report(tmp_path / "s", poses="unknown")
    found = read_cameras(tmp_path / "s")
    assert len(found) == VIEWS and told["verdict"] == "accepted", told["reasons"]
    apart = np.linalg.norm(found[:, :3, 3] - Ts[:, :3, 3], axis=1)
    assert 1e3 * apart.max() < 2.0
    size = np.linalg.norm(found[0, :3, 3] - found[-1, :3, 3])
    true = np.linalg.norm(Ts[0, :3, 3] - Ts[-1, :3, 3])
    assert size / true == pytest.approx(1.0, abs=0.01)


@pytest.mark.slow
def test_refinement_mends_poses_that_are_wrong(tmp_path: Path) -> None:
    Ts = cameras(8)
    s = np.repeat([np.radians(0.3), 2e-3], 3)
    robot = Ts @ se3.exp(s * np.random.default_rng(1).standard_normal((len(Ts), 6)))

    def between(found: np.ndarray) -> float:
        """Return the error of the poses relative to the first one [mm], median."""
        a, b = (se3.invert(T[:1]) @ T[1:] for T in (found, Ts))
        return 1e3 * float(np.median(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)))

    session(tmp_path / "wrong", Ts).set_cameras(CAMERA, dict(enumerate(robot)))
    report(tmp_path / "wrong", poses="refined")
    found = read_cameras(tmp_path / "wrong")
    assert between(found) <= max(0.5 * between(robot), 0.3)
