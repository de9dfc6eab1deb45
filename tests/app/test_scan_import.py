"""`realsim scan`: what a user sees, which exit code ends it, and what is on the disk afterwards."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from realsim.formats.bop.models import load_models, save_models
from realsim.geometry.mesh import save_ply
from realsim.geometry.parts import part
from realsim.models.convex_worker import ConvexConfig
from realsim.models.library import ModelLibrary
from realsim.models.library_prepare import PrepareConfig
from realsim.models.library_records import ScaleNote
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
    shutil.rmtree(tmp_path / "bop")


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
