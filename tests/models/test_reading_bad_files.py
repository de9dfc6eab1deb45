"""Mesh files that cannot be read are named, with what is wrong and what would be accepted."""

import json
import sys

import pytest
from PIL import Image

from bop_scenes import edit
from realsim.errors import MissingLibraryError
from realsim.geometry.mesh import ply_bytes
from realsim.models.mesh_loading import load_pieces
from realsim.models.reading import read_scan
from refusals import refused
from written_meshes import as_trimesh, textured_box, write_gltf, write_textured_obj, write_usd


def broken_files(folder):
    box = as_trimesh(textured_box())
    glb = box.export(file_type="glb")
    (folder / "cut.glb").write_bytes(glb[: len(glb) // 2])
    (folder / "noise.glb").write_bytes(bytes(range(256)) * 9)
    stl = box.export(file_type="stl")
    (folder / "cut.stl").write_bytes(stl[: len(stl) - 100])
    (folder / "noise.ply").write_bytes(b"ply\nformat nonsense\n" + bytes(range(256)))
    ply = ply_bytes(textured_box(), "m")
    (folder / "cut.ply").write_bytes(ply[: len(ply) - 60])
    (folder / "noise.obj").write_bytes(b"v a b c\nf x y z\n")
    (folder / "noise.off").write_bytes(b"OFF\n3 1\n0 0 0\n")
    (folder / "far.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")
    (folder / "empty.stl").write_bytes(b"")
    (folder / "points.ply").write_bytes(
        b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
        b"property float z\nend_header\n0 0 0\n1 1 1\n"
    )
    (folder / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    (folder / "nan.ply").write_bytes(
        b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        b"property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        b"0 0 0\n1 nan 1\n0 1 0\n3 0 1 2\n"
    )
    (folder / "point.off").write_text("OFF\n3 1 0\n1 1 1\n1 1 1\n1 1 1\n3 0 1 2\n")
    (folder / "shape.step").write_text("ISO-10303-21;")
    return sorted(p.name for p in folder.iterdir())


def test_bad_files_are_named(tmp_path):
    for name in broken_files(tmp_path):
        refused(name, read_scan, tmp_path / name, "m")
    said = {
        "empty.stl": "0 bytes",
        "points.ply": "cloud of points",
        "points.obj": "cloud of points",
        "nan.ply": "1 of 3 vertices",
        "point.off": "no extent",
        "shape.step": "not a mesh format",
    }
    for name, words in said.items():
        refused(words, read_scan, tmp_path / name, "m")
    refused("does not exist", read_scan, tmp_path / "nothing.glb", "m")


def test_bad_usd_files_are_named(tmp_path):
    pytest.importorskip("pxr", reason="the extra realsim[usd] is not installed")
    (tmp_path / "noise.usda").write_text("#usda 1.0\n(nonsense")
    (tmp_path / "noise.usdz").write_bytes(bytes(range(256)))
    (tmp_path / "nothing.usda").write_text("#usda 1.0\n(metersPerUnit = 1)\n")
    lost = 'def Xform "a" (references = @./gone.usda@</a>) {}'
    (tmp_path / "lost.usda").write_text(f"#usda 1.0\n{lost}\n")
    for name in ("noise.usda", "noise.usdz", "nothing.usda", "lost.usda"):
        refused(name, read_scan, tmp_path / name, "m")


def test_without_the_extra_usd_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    for name in [m for m in sys.modules if m == "pxr" or m.startswith("pxr.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pxr", None)  # Python's own way to forbid an import
    refused(r"realsim\[usd\]", read_scan, tmp_path / "a.usda", None, error=MissingLibraryError)


def test_a_texture_without_coordinates_is_named(tmp_path):
    Image.new("RGB", (4, 4), (200, 10, 10)).save(tmp_path / "t.png")
    (tmp_path / "box.mtl").write_text("newmtl m\nKd 0.2 0.4 0.6\nmap_Kd t.png\n")
    mesh = textured_box()
    rows = [f"v {x} {y} {z}" for x, y, z in mesh.vertices]
    rows += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
    (tmp_path / "box.obj").write_text("\n".join(["mtllib box.mtl", "usemtl m", *rows]))
    content = load_pieces(tmp_path / "box.obj")
    assert all(p.image is None for p in content.pieces)
    told = [n for n in content.notes if "no texture coordinates" in n]
    assert len(told) == 1 and "Unwrap" in told[0]


def test_a_missing_texture_is_a_note(tmp_path):
    box = textured_box()
    write_textured_obj(tmp_path / "a.obj", box, texture_name="gone.png")
    write_usd(tmp_path / "a.usda", box, texture="gone.png")
    write_gltf(tmp_path / "a.gltf", box, with_picture=False)
    edit(tmp_path / "a.gltf", lambda header: header.update(images=[{"uri": "gone.png"}]))
    for name, unit in (("a.obj", "m"), ("a.usda", None), ("a.gltf", "m")):
        scan = read_scan(tmp_path / name, unit)
        assert scan.mesh.texture is None and any("gone.png" in n for n in scan.notes)


@pytest.mark.parametrize("name", ["../skin.png", "/etc/hostname"])
def test_files_do_not_read_outside_their_folder(tmp_path, name):
    box = textured_box()
    (tmp_path / "in").mkdir()
    write_textured_obj(tmp_path / "in/a.obj", box, texture_name=name)
    (tmp_path / "in/skin.png").rename(tmp_path / "skin.png")
    refused("outside its own folder", read_scan, tmp_path / "in/a.obj", "m")
    header = {"asset": {"version": "2.0"}, "buffers": [{"uri": name, "byteLength": 3}]}
    header |= {"meshes": [], "bufferViews": [{"buffer": 0, "byteLength": 3}]}
    (tmp_path / "in/a.gltf").write_text(json.dumps(header))
    refused("outside its own folder", read_scan, tmp_path / "in/a.gltf", "m")


@pytest.mark.parametrize("name", ["../skin.png", "/etc/hostname"])
def test_usd_does_not_read_outside_its_folder(tmp_path, name):
    box = textured_box()
    (tmp_path / "in").mkdir()
    write_usd(tmp_path / "in/a.usda", box, texture=name)
    (tmp_path / "in/skin.png").rename(tmp_path / "skin.png")
    refused("outside its own folder", read_scan, tmp_path / "in/a.usda", None)
    write_usd(tmp_path / "b.usda", box)
    for outside in ("../b.usda", str(tmp_path / "b.usda")):
        (tmp_path / "in/c.usda").write_text(
            f'#usda 1.0\ndef Xform "a" (references = @{outside}@</thing>) {{}}\n'
        )
        refused("outside its own folder", read_scan, tmp_path / "in/c.usda", None)
