"""Mesh files of every format come back as the same surface, in metres, z up, with their colours.

Mesh files that cannot be read are named, with what is wrong and what would be accepted.
"""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image
from pxr import Gf, Usd, UsdGeom, UsdUtils

from bop_scenes import edit
from realsim.errors import MissingLibraryError, UnitError
from realsim.geometry.mesh import mass_properties, ply_bytes, sample_surface, save_ply
from realsim.geometry.parts import part
from realsim.models.inspect import inspect_mesh
from realsim.models.mesh_atlas import Piece, one_mesh, transformed_uv
from realsim.models.mesh_loading import load_pieces
from realsim.models.model_records import METRES
from realsim.models.reading import ROTATIONS, read_scan
from realsim.models.simplify import colors_at, deviation
from realsim.records import Mesh
from refusals import refused
from written_meshes import (
    as_trimesh,
    colorful_texture,
    textured_box,
    write_gltf,
    write_textured_obj,
    write_usd,
)

Y_UP = np.array(ROTATIONS["y"], dtype=float)
MUG, BRACKET = (replace(part(name).mesh, colors=None) for name in ("mug", "l_bracket"))


def turned(mesh, R):
    return replace(mesh, vertices=mesh.vertices @ np.asarray(R, dtype=float).T)


def colour_agreement(a, b, n=2000):
    """Return the share of points of a at which a and b have the same colour (within 3 levels)."""
    points, _ = sample_surface(a, n, np.random.default_rng(1))
    near = np.abs(colors_at(a, points).astype(int) - colors_at(b, points).astype(int))
    return float(np.mean(near.max(axis=1) <= 3))


# --- every format brings the surface back --------------------------------------------------------


@pytest.mark.parametrize("suffix", ["glb", "gltf", "obj", "stl", "off"])
def test_a_part_comes_back_from_every_format(tmp_path, suffix):
    path = tmp_path / f"mug.{suffix}"
    if suffix == "gltf":
        write_gltf(path, MUG)
    else:
        as_trimesh(MUG).export(path)
    scan = read_scan(path, "m", up="z")
    assert scan.unit == "m" and scan.factor == 1.0 and scan.declared["format"] == suffix
    assert len(scan.mesh.faces) == len(MUG.faces)
    assert deviation(scan.mesh, MUG, samples=500) < 1e-6
    volume = mass_properties(MUG, 1.0).volume_m3
    assert mass_properties(scan.mesh, 1.0).volume_m3 == pytest.approx(volume, rel=1e-5)
    report = inspect_mesh(scan.mesh)
    assert report.is_watertight and report.is_outward and report.problems == ()


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_a_part_comes_back_from_usd(tmp_path, suffix):
    path = tmp_path / f"mug.{suffix}"
    write_usd(path, MUG)
    scan = read_scan(path, None)
    assert scan.unit == "m" and scan.declared["unit"] == "metersPerUnit 1"
    np.testing.assert_allclose(scan.mesh.vertices, MUG.vertices, atol=1e-7)
    np.testing.assert_array_equal(scan.mesh.faces, MUG.faces)


def test_textures_come_back_from_every_format(tmp_path):
    box = textured_box()
    as_trimesh(box).export(tmp_path / "box.glb")
    write_textured_obj(tmp_path / "box.obj", box)
    save_ply(tmp_path / "box.ply", box, "m")
    write_usd(tmp_path / "box.usda", box)
    UsdUtils.CreateNewUsdzPackage(str(tmp_path / "box.usda"), str(tmp_path / "box.usdz"))
    for ending, unit in (("glb", "m"), ("obj", "m"), ("ply", "m"), ("usda", None), ("usdz", None)):
        scan = read_scan(tmp_path / f"box.{ending}", unit, up="z")
        assert colour_agreement(box, scan.mesh) > 0.99, ending
        np.testing.assert_array_equal(scan.mesh.texture, box.texture)


# --- several parts -------------------------------------------------------------------------------


def test_several_textures_become_one_with_all_colours(tmp_path):
    first = textured_box(seed=1)
    second = textured_box((0.03, 0.03, 0.09), seed=2)
    second = replace(second, vertices=second.vertices + np.array([0.12, 0.02, 0.0]))
    plain = trimesh.creation.icosphere(subdivisions=2, radius=0.02)
    plain.apply_translation([0, 0.1, 0])
    trimesh.Scene([as_trimesh(first), as_trimesh(second), plain]).export(tmp_path / "scene.glb")
    scan = read_scan(tmp_path / "scene.glb", "m", up="z")
    assert len(scan.mesh.faces) == len(first.faces) + len(second.faces) + len(plain.faces)
    assert colour_agreement(first, scan.mesh) > 0.99
    assert colour_agreement(second, scan.mesh) > 0.99
    assert any("laid into one" in note for note in scan.notes)


def test_a_repeated_texture_keeps_its_pattern_in_an_atlas():
    grid = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    uv = np.array([[-1.25, 0.5], [1.25, 0.5], [1.25, 2.0], [-1.25, 2.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    image = colorful_texture()
    tiled = Piece(name="a", vertices=grid, faces=faces, uv=uv, image=image, image_key="a")
    other = replace(
        tiled, name="b", vertices=grid + np.array([0, 0, 1]), uv=grid[:, :2],
        image=colorful_texture(seed=5), image_key="b",
    )  # fmt: skip
    alone, notes = one_mesh([tiled])
    assert any("repeats" in note for note in notes)
    np.testing.assert_array_equal(alone.uv, uv)
    atlas, _ = one_mesh([tiled, other])
    assert atlas.uv.min() >= 0 and atlas.uv.max() <= 1
    assert colour_agreement(alone, atlas) > 0.99
    assert colour_agreement(one_mesh([other])[0], atlas) > 0.99


def test_nodes_are_placed_and_mirrored_ones_stay_outward(tmp_path):
    solid = as_trimesh(BRACKET)
    scene = trimesh.Scene()
    T = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3], [0.0, 0.1, 0.0])
    scene.add_geometry(solid, node_name="straight", geom_name="part", transform=T)
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirror[0, 3] = -0.3
    scene.add_geometry(solid, node_name="flipped", geom_name="part", transform=mirror)
    scene.export(tmp_path / "two.glb")
    scan = read_scan(tmp_path / "two.glb", "m", up="z")
    expected = np.concatenate([solid.vertices @ m[:3, :3].T + m[:3, 3] for m in (T, mirror)])
    found = np.sort(scan.mesh.vertices, axis=0)
    np.testing.assert_allclose(found, np.sort(expected, axis=0), atol=1e-6)
    assert inspect_mesh(scan.mesh).is_outward
    assert sum("'flipped' is mirrored" in n for n in scan.notes) == 1
    assert mass_properties(scan.mesh, 1.0).volume_m3 == pytest.approx(2 * solid.volume, rel=1e-5)


def test_usd_transforms_instances_and_mirrors(tmp_path):
    write_usd(tmp_path / "part.usda", BRACKET)
    stage = Usd.Stage.CreateNew(str(tmp_path / "scene.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.Xform.Define(stage, "/root")
    shifts = 0.3 * np.eye(3)
    for i, shift in enumerate(shifts):
        at = UsdGeom.Xform.Define(stage, f"/root/at{i}")
        at.AddTranslateOp().Set(Gf.Vec3d(*map(float, shift)))
        if i == 2:
            at.AddScaleOp().Set(Gf.Vec3f(1, -1, 1))
        copy = stage.DefinePrim(f"/root/at{i}/copy")
        copy.GetReferences().AddReference("./part.usda", "/thing")
        copy.SetInstanceable(i < 2)
    points = UsdGeom.PointInstancer.Define(stage, "/root/many")
    stage.DefinePrim("/root/many/kind").GetReferences().AddReference("./part.usda", "/thing")
    points.CreatePrototypesRel().SetTargets(["/root/many/kind"])
    points.CreateProtoIndicesAttr([0, 0])
    points.CreatePositionsAttr([Gf.Vec3f(-0.3, 0, 0), Gf.Vec3f(0, -0.3, 0)])
    assert UsdGeom.Cube.Define(stage, "/root/cube")
    stage.GetRootLayer().Save()

    scan = read_scan(tmp_path / "scene.usda", None)
    n = len(BRACKET.vertices)
    assert len(scan.mesh.faces) == 5 * len(BRACKET.faces)
    centers = scan.mesh.vertices.reshape(5, n, 3).mean(axis=1)
    own = BRACKET.vertices.mean(axis=0)
    expected = [own + s for s in shifts[:2]] + [own * [1, -1, 1] + shifts[2]]
    expected = np.array(expected + [own - s for s in shifts[:2]])
    a, b = (x[np.lexsort(x.round(5).T)] for x in (centers, expected))
    np.testing.assert_allclose(a, b, atol=1e-6)
    assert inspect_mesh(scan.mesh).is_outward
    assert any("mirrored" in note for note in scan.notes)
    assert any("Cube" in note for note in scan.notes)


def test_usd_left_handed_winding_is_turned(tmp_path):
    stage = write_usd(tmp_path / "a.usda", replace(BRACKET, faces=BRACKET.faces[:, ::-1]))
    UsdGeom.Mesh(stage.GetPrimAtPath("/thing/shape")).CreateOrientationAttr("leftHanded")
    stage.GetRootLayer().Save()
    scan = read_scan(tmp_path / "a.usda", None)
    assert inspect_mesh(scan.mesh).is_outward and any("left-handed" in n for n in scan.notes)


# --- unit and axes -------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", list(METRES))
def test_units_are_converted_exactly(tmp_path, unit):
    numbers = np.array([[0.0, 0, 0], [5, 0, 0], [0, 4, 0], [0, 0, 3]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    scale = 0.02 if unit == "m" else 1.0
    mesh = Mesh(vertices=numbers * scale, faces=faces)
    (tmp_path / "t.off").write_text(as_trimesh(mesh).export(file_type="off"))
    scan = read_scan(tmp_path / "t.off", unit)
    factor = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}[unit]
    assert scan.factor == factor
    np.testing.assert_allclose(scan.mesh.vertices, numbers * scale * factor, rtol=1e-12)
    none = read_scan(tmp_path / "t.off", "none")
    np.testing.assert_allclose(none.mesh.vertices, numbers * scale, rtol=1e-12)
    assert none.unit == "none" and none.factor == 1.0


def test_without_a_unit_the_message_says_what_each_would_be(tmp_path):
    mesh = as_trimesh(textured_box((0.98, 0.5, 0.3)))
    for name in ("a.stl", "a.glb"):
        mesh.export(tmp_path / name)
        sizes = r"980 mm as m, 9\.8 mm as cm, 0\.98 mm as mm.*--unit none"
        refused(sizes, read_scan, tmp_path / name, None)


def test_impossible_sizes_are_refused(tmp_path):
    for size, unit, says in ((0.1, "mm", r"0\.1 mm large"), (100.0, "m", "100 m large"),
                             (100.0, "feet", "not known")):  # fmt: skip
        as_trimesh(textured_box((size, 0.6 * size, 0.4 * size))).export(tmp_path / "a.stl")
        refused(says, read_scan, tmp_path / "a.stl", unit, error=UnitError)


def test_usd_states_its_unit_and_a_contradiction_names_both(tmp_path):
    box = textured_box((100.0, 60.0, 40.0))
    write_usd(tmp_path / "a.usda", box, metres=0.001)
    scan = read_scan(tmp_path / "a.usda", None)
    assert scan.unit == "mm" and scan.mesh.extent.max() == pytest.approx(0.1)
    assert read_scan(tmp_path / "a.usda", "mm").factor == 0.001
    assert read_scan(tmp_path / "a.usda", "none").unit == "none"
    both = "states its unit as mm, but --unit cm"
    refused(both, read_scan, tmp_path / "a.usda", "cm", error=UnitError)
    write_usd(tmp_path / "b.usda", box, metres=None)
    refused("does not state its unit", read_scan, tmp_path / "b.usda", None)
    write_usd(tmp_path / "c.usda", box, metres=0.3048)
    refused(r"metersPerUnit 0\.3048", read_scan, tmp_path / "c.usda", None)


@pytest.mark.parametrize("up", list(ROTATIONS))
def test_up_axes_are_turned_by_proper_rotations(tmp_path, up):
    R = np.array(ROTATIONS[up], dtype=float)
    np.testing.assert_array_equal(R @ R.T, np.eye(3))
    assert np.linalg.det(R) == pytest.approx(1.0)
    axis = {"x": 0, "y": 1, "z": 2}[up[-1]]
    e = np.zeros(3)
    e[axis] = -1.0 if up.startswith("-") else 1.0
    np.testing.assert_array_equal(R @ e, [0, 0, 1])
    (tmp_path / "a.ply").write_bytes(ply_bytes(turned(BRACKET, R.T), "m"))
    scan = read_scan(tmp_path / "a.ply", "m", up=up)
    np.testing.assert_array_equal(scan.R_up, R)
    np.testing.assert_allclose(scan.mesh.vertices, BRACKET.vertices, atol=1e-7)


def test_gltf_and_usd_say_which_axis_is_up(tmp_path):
    as_trimesh(turned(BRACKET, Y_UP.T)).export(tmp_path / "a.glb")
    scan = read_scan(tmp_path / "a.glb", "m")
    np.testing.assert_allclose(scan.mesh.vertices, BRACKET.vertices, atol=1e-7)
    np.testing.assert_array_equal(scan.R_up, Y_UP)
    as_trimesh(BRACKET).export(tmp_path / "a.stl")
    kept = read_scan(tmp_path / "a.stl", "m")
    np.testing.assert_array_equal(kept.R_up, np.eye(3))
    assert any("axes are kept" in note for note in kept.notes)
    write_usd(tmp_path / "a.usda", turned(BRACKET, Y_UP.T), up="Y")
    scan = read_scan(tmp_path / "a.usda", None)
    np.testing.assert_allclose(scan.mesh.vertices, BRACKET.vertices, atol=1e-7)


def test_texture_transforms_of_gltf_and_usd():
    uv = np.array([[0.2, 0.7], [0.4, 0.1]])
    np.testing.assert_allclose(transformed_uv(uv, (0, 0), 0.0, (1, 1), v_down=True), uv)
    # glTF's own example: offset (0, 1) and rotation pi/2 turn the picture by 90 degrees.
    turned_uv = transformed_uv(uv, (0.0, 1.0), np.pi / 2, (0.5, 0.5), v_down=True)
    down = np.stack([uv[:, 0], 1 - uv[:, 1]], -1)
    expected = np.stack([0.5 * down[:, 1], 1 - 0.5 * down[:, 0]], -1)
    np.testing.assert_allclose(turned_uv, np.stack([expected[:, 0], 1 - expected[:, 1]], -1))
    up = transformed_uv(uv, (0.1, 0.0), np.pi / 2, (2.0, 1.0), v_down=False)
    np.testing.assert_allclose(up, np.stack([0.1 - uv[:, 1], 2 * uv[:, 0]], -1), atol=1e-12)


def broken_files():
    """Return bytes by name, with what is said of them beside the name."""
    box, ply = as_trimesh(textured_box()), ply_bytes(textured_box(), "m")
    glb, stl = (box.export(file_type=kind) for kind in ("glb", "stl"))
    noise, xyz = bytes(range(256)), b"property float x\nproperty float y\nproperty float z\n"
    return {
        "cut.glb": (glb[: len(glb) // 2], ""),
        "noise.glb": (noise * 9, ""),
        "cut.stl": (stl[: len(stl) - 100], ""),
        "noise.ply": (b"ply\nformat nonsense\n" + noise, ""),
        "cut.ply": (ply[: len(ply) - 60], ""),
        "noise.obj": (b"v a b c\nf x y z\n", ""),
        "noise.off": (b"OFF\n3 1\n0 0 0\n", ""),
        "far.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", ""),
        "empty.stl": (b"", "0 bytes"),
        "points.ply": (
            b"ply\nformat ascii 1.0\nelement vertex 2\n" + xyz + b"end_header\n0 0 0\n1 1 1\n",
            "cloud of points",
        ),
        "points.obj": (b"v 0 0 0\nv 1 0 0\n", "cloud of points"),
        "nan.ply": (
            b"ply\nformat ascii 1.0\nelement vertex 3\n" + xyz + b"element face 1\nproperty list "
            b"uchar int vertex_indices\nend_header\n0 0 0\n1 nan 1\n0 1 0\n3 0 1 2\n",
            "1 of 3 vertices",
        ),
        "point.off": (b"OFF\n3 1 0\n1 1 1\n1 1 1\n1 1 1\n3 0 1 2\n", "no extent"),
        "shape.step": (b"ISO-10303-21;", "not a mesh format"),
        "noise.usda": (b"#usda 1.0\n(nonsense", ""),
        "noise.usdz": (noise, ""),
        "nothing.usda": (b"#usda 1.0\n(metersPerUnit = 1)\n", ""),
        "lost.usda": (b'#usda 1.0\ndef Xform "a" (references = @./gone.usda@</a>) {}\n', ""),
    }


def test_bad_files_are_named(tmp_path):
    for name, (data, says) in broken_files().items():
        (tmp_path / name).write_bytes(data)
        assert says in refused(name, read_scan, tmp_path / name, "m")
    refused("does not exist", read_scan, tmp_path / "nothing.glb", "m")


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
    box, inside = textured_box(), tmp_path / "in"
    inside.mkdir()
    write_textured_obj(inside / "a.obj", box, texture_name=name)
    write_usd(inside / "a.usda", box, texture=name)
    (inside / "skin.png").rename(tmp_path / "skin.png")
    header = {"asset": {"version": "2.0"}, "buffers": [{"uri": name, "byteLength": 3}]}
    header |= {"meshes": [], "bufferViews": [{"buffer": 0, "byteLength": 3}]}
    (inside / "a.gltf").write_text(json.dumps(header))
    write_usd(tmp_path / "b.usda", box)
    for k, outside in enumerate(("../b.usda", tmp_path / "b.usda")):
        text = f'#usda 1.0\ndef Xform "a" (references = @{outside}@</thing>) {{}}\n'
        (inside / f"{k}.usda").write_text(text)
    for file in ("a.obj", "a.gltf", "a.usda", "0.usda", "1.usda"):
        unit = None if file.endswith("usda") else "m"
        refused("outside its own folder", read_scan, inside / file, unit)
