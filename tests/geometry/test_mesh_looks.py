"""What a mesh file names and lacks is said, with what stands for it: never silently grey."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from realsim.geometry.mesh import load_mesh
from realsim.records import Mesh

VERTICES = "v 0 0 0\nv .1 0 0\nv .1 .1 0\nv 0 .1 0\n"
UV = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
WITH_UV = "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
WITHOUT_UV = "f 1 2 3\nf 1 3 4\n"
RED = "newmtl a\nKd 0.8 0.1 0.1\n"
PLY = (
    "ply\nformat ascii 1.0\ncomment TextureFile gone.png\nelement vertex 3\n"
    "property float x\nproperty float y\nproperty float z\n"
    "property float texture_u\nproperty float texture_v\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0 0 0\n.1 0 0 1 0\n.1 .1 0 1 1\n3 0 1 2\n"
)


def obj(folder: Path, body: str, table: str | None = None) -> Path:
    (folder / "m.obj").write_text(f"mtllib m.mtl\nusemtl a\n{VERTICES}{body}")
    if table is not None:
        (folder / "m.mtl").write_text(table)
    return folder / "m.obj"


def loaded(path: Path) -> tuple[Mesh, list[str]]:
    """A mesh in metres, and what was said about it."""
    notes: list[str] = []
    return load_mesh(path, "m", notes), notes


def test_a_whole_texture_is_kept_without_a_word(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "t.png"), np.full((4, 4, 3), (10, 200, 30), np.uint8))
    mesh, notes = loaded(obj(tmp_path, UV + WITH_UV, RED + "map_Kd t.png\n"))
    assert mesh.texture is not None and tuple(mesh.texture[0, 0]) == (30, 200, 10)
    assert notes == []


def test_a_missing_texture_leaves_the_materials_colour(tmp_path: Path) -> None:
    mesh, notes = loaded(obj(tmp_path, UV + WITH_UV, RED + "map_Kd gone.png\n"))
    assert mesh.texture is None and mesh.colors is not None
    assert tuple(mesh.colors[0]) == (204, 26, 26)
    assert len(notes) == 1
    assert "'gone.png'" in notes[0] and "sRGB 204 26 26" in notes[0]


def test_a_broken_texture_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad.png").write_bytes(b"no picture")
    mesh, notes = loaded(obj(tmp_path, UV + WITH_UV, RED + "map_Kd bad.png\n"))
    assert mesh.texture is None
    assert "'bad.png'" in notes[0] and "cannot be decoded" in notes[0]


def test_a_missing_material_table_leaves_no_colour_instead_of_grey(tmp_path: Path) -> None:
    mesh, notes = loaded(obj(tmp_path, UV + WITH_UV))
    assert mesh.texture is None and mesh.colors is None
    assert "'m.mtl'" in notes[0] and "procedural material" in notes[0]


def test_a_texture_without_coordinates_is_named(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "t.png"), np.zeros((4, 4, 3), np.uint8))
    mesh, notes = loaded(obj(tmp_path, WITHOUT_UV, RED + "map_Kd t.png\n"))
    assert mesh.texture is None
    assert "'t.png'" in notes[0] and "no texture coordinates" in notes[0]


def test_a_ply_without_its_texture_is_named_and_prints_no_traceback(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "m.ply").write_text(PLY)
    mesh, notes = loaded(tmp_path / "m.ply")
    assert mesh.texture is None and mesh.colors is None and mesh.uv is not None
    assert "'gone.png'" in notes[0]
    assert "Traceback" not in capfd.readouterr().err


def test_texture_coordinates_alone_make_no_texture(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(VERTICES + UV + WITH_UV)
    mesh, notes = loaded(tmp_path / "m.obj")
    assert mesh.texture is None and mesh.colors is None and mesh.uv is not None
    assert notes == []


def test_where_nobody_takes_notes_it_is_a_warning(tmp_path: Path) -> None:
    path = obj(tmp_path, UV + WITH_UV, RED + "map_Kd gone.png\n")
    with pytest.warns(UserWarning, match=r"'gone\.png', named in it, is not in its folder"):
        mesh = load_mesh(path, "m")
    assert mesh.texture is None and mesh.colors is not None
