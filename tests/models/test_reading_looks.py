"""Looks that cannot be read are named: a texture without texture coordinates."""

from pathlib import Path

import trimesh
from PIL import Image

from realsim.models.mesh_loading import load_pieces

BOX = trimesh.creation.box((0.1, 0.1, 0.1))


def test_a_texture_without_coordinates_is_named(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4), (200, 10, 10)).save(tmp_path / "t.png")
    (tmp_path / "box.mtl").write_text("newmtl m\nKd 0.2 0.4 0.6\nmap_Kd t.png\n")
    rows = [f"v {x} {y} {z}" for x, y, z in BOX.vertices]
    rows += [f"f {a} {b} {c}" for a, b, c in BOX.faces + 1]
    (tmp_path / "box.obj").write_text("\n".join(["mtllib box.mtl", "usemtl m", *rows]))
    content = load_pieces(tmp_path / "box.obj")
    assert all(p.image is None for p in content.pieces)
    told = [n for n in content.notes if "no texture coordinates" in n]
    assert len(told) == 1 and "Unwrap" in told[0]
