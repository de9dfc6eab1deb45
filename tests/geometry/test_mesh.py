"""Meshes: analytic masses, files that come back the same, units that are found out."""

import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from realsim.errors import InputError, UnitError
from realsim.geometry import mesh as meshes
from realsim.geometry import mesh_files, metrics, se3
from realsim.geometry.mesh import load_mesh
from realsim.records import Mesh, ObjectModel
from refusals import refused
from trimesh_solids import ball, box

DATA = Path(os.environ.get("REALSIM_DATA", Path(__file__).parents[2] / "../shared/data"))
YCBV = DATA / "scenes/ycbv_mini"
needs_ycbv = pytest.mark.skipif(not YCBV.is_dir(), reason=f"no YCB-V data at {YCBV}")


def textured_square():
    return Mesh(
        vertices=0.1 * np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]),
        faces=np.array([[0, 1, 2], [0, 2, 3]]),
        uv=np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]),
        # The first row is at v = 1: red on top, green below.
        texture=np.array([[[255, 0, 0]] * 2, [[0, 255, 0]] * 2], dtype=np.uint8),
    )


# --- mass ----------------------------------------------------------------------------------------


def test_the_mass_of_a_box_is_that_of_the_formula():
    a, b, c = 0.1, 0.06, 0.04
    m = meshes.mass_properties(box((a, b, c)), 500.0)
    assert m.is_watertight
    assert m.volume_m3 == pytest.approx(a * b * c, rel=1e-12)
    assert m.mass_kg == pytest.approx(500 * a * b * c, rel=1e-12)
    expected = m.mass_kg / 12 * np.diag([b * b + c * c, a * a + c * c, a * a + b * b])
    np.testing.assert_allclose(m.inertia, expected, atol=1e-15)
    np.testing.assert_allclose(m.center_of_mass, 0, atol=1e-15)
    assert m.hull_volume_fraction == pytest.approx(1)


def test_mass_moves_and_turns_with_the_mesh():
    # Far off the origin, where a sum of tetrahedra about the origin would lose its digits.
    solid = box()
    T = se3.from_rt(se3.random_rotation(np.random.default_rng(0)), [40.0, -30.0, 20.0])
    still, moved = (meshes.mass_properties(m, 700.0) for m in (solid, meshes.transformed(solid, T)))
    assert moved.mass_kg == pytest.approx(still.mass_kg, rel=1e-9)
    center = se3.transform(T, still.center_of_mass[None])[0]
    np.testing.assert_allclose(moved.center_of_mass, center, atol=1e-9)
    R = T[:3, :3]
    np.testing.assert_allclose(moved.inertia, R @ still.inertia @ R.T, atol=1e-12)


def test_two_boxes_weigh_the_sum_and_inside_out_changes_nothing():
    both = meshes.merged([box(), meshes.transformed(box(), se3.from_translation([0.3, 0, 0]))])
    m = meshes.mass_properties(both, 1000.0)
    assert m.mass_kg == pytest.approx(2 * meshes.mass_properties(box(), 1000.0).mass_kg)
    assert m.hull_volume_fraction < 0.6
    flipped = meshes.mass_properties(replace(both, faces=both.faces[:, ::-1]), 1000.0)
    np.testing.assert_allclose(flipped.inertia, m.inertia, atol=1e-15)


def test_an_open_mesh_weighs_what_its_hull_weighs_and_says_so():
    m = meshes.mass_properties(replace(box(), faces=box().faces[:-2]), 1000.0)
    assert not m.is_watertight and m.hull_volume_fraction == pytest.approx(1)
    assert m.volume_m3 == pytest.approx(0.1 * 0.06 * 0.04)


def test_seams_in_the_texture_do_not_open_a_mesh():
    solid = box()
    split = Mesh(vertices=solid.vertices[solid.faces.ravel()], faces=np.arange(36).reshape(12, 3))
    assert meshes.mass_properties(split, 1000.0).is_watertight


def test_a_flat_mesh_has_no_mass():
    refused("flat", meshes.mass_properties, textured_square(), 1000.0)


# --- shape ---------------------------------------------------------------------------------------


def test_diameters():
    assert meshes.diameter(box()) == pytest.approx(np.linalg.norm([0.1, 0.06, 0.04]))
    assert meshes.diameter(ball(0.05)) == pytest.approx(0.1, rel=1e-9)
    assert meshes.diameter(textured_square()) == pytest.approx(0.1 * np.sqrt(2))


def test_normals_point_outwards():
    solid = ball(0.05)
    centers = solid.vertices[solid.faces].mean(axis=1)
    outward = centers / np.linalg.norm(centers, axis=1, keepdims=True)
    assert (np.einsum("ij,ij->i", meshes.face_normals(solid), outward) > 0.999).all()
    np.testing.assert_allclose(meshes.vertex_normals(solid), solid.vertices / 0.05, atol=2e-2)


def test_samples_lie_on_the_surface_evenly():
    solid = box()
    points, normals = meshes.sample_surface(solid, 20_000, np.random.default_rng(0))
    half = np.array([0.05, 0.03, 0.02])
    np.testing.assert_allclose(np.abs(np.abs(points) - half).min(axis=1), 0, atol=1e-12)
    side = np.abs(normals).argmax(axis=1)
    areas = np.array([0.06 * 0.04, 0.1 * 0.04, 0.1 * 0.06])
    share = np.bincount(side, minlength=3) / len(points)
    np.testing.assert_allclose(share, areas / areas.sum(), atol=0.02)
    np.testing.assert_allclose(points.mean(axis=0), 0, atol=2e-3)
    # Evenly within each triangle, too: all barycentric coordinates have the mean 1/3.
    corner = Mesh(vertices=np.eye(3), faces=np.array([[0, 1, 2]]))
    inside, _ = meshes.sample_surface(corner, 20_000, np.random.default_rng(0))
    np.testing.assert_allclose(inside.mean(axis=0), 1 / 3, atol=0.01)
    again, _ = meshes.sample_surface(solid, 20_000, np.random.default_rng(0))
    assert np.array_equal(points, again)


def test_symmetries_are_a_closed_set_that_keeps_the_object():
    model = ObjectModel(
        obj_id=1, name="can", mesh=box(),
        symmetries=np.stack([np.eye(4), np.diag([1.0, -1, -1, 1])]),
        symmetry_axes=(((0.0, 0.0, 2.0), (0.01, 0.0, 0.0)),),
    )  # fmt: skip
    S = meshes.symmetry_transforms(model, max_step_rad=0.5)
    assert S.shape == (2 * 13, 4, 4)
    np.testing.assert_allclose(S[0], np.eye(4), atol=1e-15)
    se3.check_rigid(S, "symmetries")
    turns = S[:: 2 if np.allclose(S[1], model.symmetries[1]) else 1][:13]
    on_axis = np.array([[0.01, 0.0, 0.3]])
    turned = se3.transform(turns, on_axis[None].repeat(13, 0))[:, 0]
    np.testing.assert_allclose(turned, on_axis.repeat(13, 0), atol=1e-12)
    plain = replace(model, symmetry_axes=())
    np.testing.assert_array_equal(meshes.symmetry_transforms(plain), plain.symmetries)


# --- metrics -------------------------------------------------------------------------------------


def brute_mssd(T_true, T_estimated, vertices, symmetries):
    estimated = se3.transform(T_estimated, vertices)
    return min(
        np.linalg.norm(estimated - se3.transform(T_true @ S, vertices), axis=1).max()
        for S in symmetries
    )


def test_mssd_is_the_definition_and_the_hull_is_enough():
    rng = np.random.default_rng(1)
    vertices = rng.normal(scale=0.05, size=(500, 3))
    S = np.concatenate([np.eye(4)[None], se3.random_transform(rng, 5, spread=0.01)])
    for _ in range(10):
        A, B = se3.random_transform(rng, 2, spread=0.02)
        expected = brute_mssd(A, B, vertices, S)
        assert metrics.mssd(A, B, vertices, S) == pytest.approx(expected, rel=1e-12)


def test_mssd_does_not_depend_on_the_frame_and_knows_symmetries():
    A, B, C = se3.random_transform(np.random.default_rng(2), 3)
    v = box().vertices
    S = np.stack([np.eye(4), np.diag([-1.0, -1, 1, 1])])
    assert metrics.mssd(C @ A, C @ B, v, S) == pytest.approx(metrics.mssd(A, B, v, S), rel=1e-9)
    assert metrics.mssd(A, A @ S[1], v, S) < 1e-15 < metrics.mssd(A, A @ S[1], v)
    assert metrics.mssd(A, A @ se3.from_translation([0, 0.003, 0]), v, S) == pytest.approx(0.003)
    refused("symmetries", metrics.mssd, A, B, v, np.zeros((0, 4, 4)))


def test_angles_and_distances():
    T = se3.exp([0, 0, np.radians(3), 0, 0, 0])
    moved = T @ se3.from_translation([0.003, 0, 0.004])
    assert metrics.rotation_error_deg(np.eye(4), T) == pytest.approx(3)
    assert metrics.translation_error_mm(T, moved) == pytest.approx(5)
    assert metrics.rotation_error_deg(np.stack([T, T]), np.eye(4)).shape == (2,)


def test_overlap_of_masks():
    a = np.zeros((4, 4), bool)
    b = a.copy()
    assert np.isnan(metrics.mask_iou(a, b))
    a[:2], b[1:3] = True, True
    assert metrics.mask_iou(a, b) == pytest.approx(1 / 3)
    assert metrics.mask_iou(a, a) == 1 and metrics.mask_iou(a, ~a) == 0
    refused("sizes", metrics.mask_iou, a, b[:2])


# --- files ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("ascii", [False, True])
@pytest.mark.parametrize("unit", ["m", "mm"])
def test_a_ply_comes_back_the_same(tmp_path, ascii, unit):
    mesh = replace(box(), colors=np.random.default_rng(0).integers(0, 256, (8, 3)))
    meshes.save_ply(tmp_path / "box.ply", mesh, unit, ascii=ascii)
    back = meshes.load_mesh(tmp_path / "box.ply", unit)
    np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-8)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_array_equal(back.colors, mesh.colors)


@pytest.mark.parametrize("colors", [None, np.arange(24).reshape(8, 3), np.full((8, 3), 9)])
def test_a_plain_ply_is_what_the_general_reader_makes_of_it(tmp_path, monkeypatch, colors):
    data = meshes.ply_bytes(replace(box(), colors=colors), "mm")
    path = tmp_path / "box.ply"
    path.write_bytes(data)
    ours = meshes.load_mesh(path, "mm")
    header = data.index(b"end_header\n")
    beyond = data[:-4] + b"\x08\0\0\0"  # of vertices 0 to 7
    odd = (data[:-1], data + b"\0", data[: header + 9], data.replace(b" 8\n", b" 9\n"), beyond)
    assert all(mesh_files._plain_ply(d) is None for d in odd)
    monkeypatch.setattr(mesh_files, "_plain_ply", lambda _: None)
    theirs = meshes.load_mesh(path, "mm")
    for name in ("vertices", "faces", "colors"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


def test_a_textured_ply_comes_back_right_side_up(tmp_path):
    meshes.save_ply(tmp_path / "square.ply", textured_square(), "mm")
    back = meshes.load_mesh(tmp_path / "square.ply", "mm")
    np.testing.assert_array_equal(back.texture, textured_square().texture)
    np.testing.assert_allclose(back.uv, textured_square().uv)
    # The corner at v = 0 is green, the one at v = 1 is red.
    colors = meshes.vertex_colors(replace(back, uv=np.clip(back.uv, 0.1, 0.9)))
    assert colors.tolist() == [[0, 255, 0]] * 2 + [[255, 0, 0]] * 2


@pytest.mark.parametrize("ending", ["stl", "obj", "glb"])
def test_other_formats_give_the_same_solid(tmp_path, ending):
    meshes.to_trimesh(ball(0.05, 2)).export(tmp_path / f"ball.{ending}")
    back = meshes.load_mesh(tmp_path / f"ball.{ending}", "m")
    assert len(back.vertices) == len(ball(0.05, 2).vertices)
    m = meshes.mass_properties(back, 1000.0)
    assert m.is_watertight
    whole = meshes.mass_properties(ball(0.05, 2), 1000.0)
    assert m.volume_m3 == pytest.approx(whole.volume_m3, rel=1e-5)


def test_metres_said_to_be_millimetres_are_found_out(tmp_path):
    meshes.save_ply(tmp_path / "box.ply", box(), "m")
    refused(r"0\.1 mm.*0\.1 m", meshes.load_mesh, tmp_path / "box.ply", "mm", error=UnitError)


def test_millimetres_said_to_be_metres_are_found_out(tmp_path):
    meshes.save_ply(tmp_path / "box.ply", box(), "mm")
    with pytest.raises(UnitError, match=r"100 m; in millimetres it would be 100 mm"):
        meshes.load_mesh(tmp_path / "box.ply", "m")


def test_what_is_no_mesh_is_an_error_that_names_the_file(tmp_path):
    refused("does not exist", meshes.load_mesh, tmp_path / "mug.ply", "m")
    (tmp_path / "mug.dae").write_text("")
    refused(r"\.ply, \.obj", meshes.load_mesh, tmp_path / "mug.dae", "m")
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement")
    with pytest.raises(InputError, match=r"broken\.ply cannot .* cut off or damaged\. Copy"):
        meshes.load_mesh(tmp_path / "broken.ply", "m")
    header = "ply\nformat ascii 1.0\nelement vertex 1\n"
    header += "property float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"
    (tmp_path / "cloud.ply").write_text(header)
    refused("no triangles", meshes.load_mesh, tmp_path / "cloud.ply", "m")


def test_merging_keeps_colours_and_lets_textures_become_colours():
    square, solid = textured_square(), box()
    one = meshes.merged([square, solid])
    assert len(one.faces) == len(square.faces) + len(solid.faces)
    assert one.colors.shape == (len(one.vertices), 3)
    assert (one.colors[4:] == meshes.GREY).all() and one.texture is None
    assert meshes.merged([square]) is square
    assert meshes.merged([solid, solid]).colors is None


@needs_ycbv
def test_a_real_scan_keeps_its_texture():
    mesh = meshes.load_mesh(YCBV / "meshes_textured/003_cracker_box/textured.obj", "m")
    assert mesh.texture.shape == (512, 512, 3)
    assert mesh.uv.min() >= 0 and mesh.uv.max() <= 1
    assert meshes.diameter(mesh) == pytest.approx(0.2696101, abs=1e-6)
    # The box is red: most of its vertices are, if the texture stands the right way up.
    r, g, b = meshes.vertex_colors(mesh).astype(float).mean(axis=0)
    assert r > 1.3 * g and r > 1.3 * b
    with pytest.raises(UnitError):
        meshes.load_mesh(YCBV / "meshes_textured/003_cracker_box/textured.obj", "mm")


def test_ctrl_c_is_not_taken_for_a_mesh_without_colours(tmp_path, monkeypatch):
    parts = [trimesh.creation.box(), trimesh.creation.icosphere(1)]
    for part, rgba in zip(parts, ([255, 0, 0, 255], [0, 0, 255, 255]), strict=True):
        part.visual.vertex_colors = rgba
    trimesh.Scene(parts).export(tmp_path / "two.glb")
    joined = trimesh.visual.ColorVisuals.concatenate

    def struck(*arguments):
        signal.raise_signal(signal.SIGINT)
        return joined(*arguments)

    monkeypatch.setattr(trimesh.visual.ColorVisuals, "concatenate", struck)
    with pytest.raises(KeyboardInterrupt):
        meshes.load_mesh(tmp_path / "two.glb", "m")


# --- What a mesh file names and lacks is said, with what stands for it: never silently grey.

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


@pytest.mark.parametrize(
    ("body", "table", "words", "color"),
    [
        (UV + WITH_UV, "map_Kd gone.png\n", ("'gone.png'", "sRGB 204 26 26"), (204, 26, 26)),
        (UV + WITH_UV, "map_Kd bad.png\n", ("'bad.png'", "cannot be decoded"), (204, 26, 26)),
        (UV + WITH_UV, None, ("'m.mtl'", "procedural material"), None),
        (WITHOUT_UV, "map_Kd t.png\n", ("'t.png'", "no texture coordinates"), (204, 26, 26)),
    ],
)
def test_a_texture_that_is_lacking_is_named_and_leaves_the_materials_colour(
    tmp_path: Path, body: str, table: str | None, words: tuple[str, ...], color: Any
) -> None:
    (tmp_path / "bad.png").write_bytes(b"no picture")
    cv2.imwrite(str(tmp_path / "t.png"), np.zeros((4, 4, 3), np.uint8))
    mesh, (note,) = loaded(obj(tmp_path, body, table and RED + table))
    assert mesh.texture is None and all(word in note for word in words)
    assert (mesh.colors if color is None else tuple(mesh.colors[0])) == color


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
