"""Models as the browser takes them: few triangles, the same outline, glTF that others read."""

import io

import numpy as np
import trimesh

from plain_meshes import box
from realsim import CameraIntrinsics, Mesh
from realsim.geometry import se3
from realsim.models.simplify import deviation
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.review.content.config import SceneConfig
from realsim.review.content.meshes import glb_of, within_budget

CAMERA = CameraIntrinsics(width=400, height=300, fx=900.0, fy=900.0, cx=199.5, cy=149.5)


def dented_ball(faces: int) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=round(np.log(faces / 20) / np.log(4)))
    v = np.asarray(ball.vertices)
    v = v * (1 + 0.15 * np.sin(4 * v[:, :1]) * np.cos(3 * v[:, 1:2])) * [0.05, 0.04, 0.06]
    rgb = np.clip(255 * (v / 0.12 + 0.5), 0, 255).astype(np.uint8)
    return Mesh(vertices=v, faces=np.asarray(ball.faces, np.int32), colors=rgb)


def textured_square() -> Mesh:
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]], float)
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32, :, 0], texture[32:, :, 2] = 250, 250  # red above, blue below
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    return Mesh(
        vertices=vertices, faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32), uv=uv, texture=texture
    )


def loaded(glb: bytes) -> trimesh.Trimesh:
    scene = trimesh.load(io.BytesIO(glb), file_type="glb", process=False)
    assert isinstance(scene, trimesh.Scene)
    return next(iter(scene.geometry.values()))


def outline(mesh: Mesh, T_world_cam: np.ndarray) -> np.ndarray:
    return LabelRenderer([PlacedMesh(0, mesh, np.eye(4))]).render(CAMERA, T_world_cam).ids == 0


def test_a_decimated_mesh_keeps_its_outline_and_its_colours() -> None:
    mesh = dented_ball(20 * 4**5)
    few = within_budget(mesh, SceneConfig(most_triangles=5_000))
    assert len(few.faces) <= 7_500 < len(mesh.faces)
    assert deviation(mesh, few) < 1e-3 and deviation(mesh, few, quantile=0.95) < 3e-4
    rng = np.random.default_rng(0)
    for _ in range(2):
        eye = rng.normal(size=3)
        T = se3.look_at(0.35 * eye / np.linalg.norm(eye), [0.0, 0.0, 0.0])
        a, b = outline(mesh, T), outline(few, T)
        assert np.sum(a & b) / np.sum(a | b) > 0.995
    assert few.colors is not None
    assert np.abs(few.colors - np.clip(255 * (few.vertices / 0.12 + 0.5), 0, 255)).max() < 8


def test_a_mesh_is_not_touched_below_its_budget_and_textures_have_a_larger_one() -> None:
    square = textured_square()
    assert within_budget(square, SceneConfig(most_triangles=1, most_textured_triangles=2)) is square
    plain = box((0.1, 0.1, 0.1), (180, 60, 40))
    assert within_budget(plain, SceneConfig(most_triangles=12)) is plain


def test_the_gltf_has_the_same_surface_for_another_reader() -> None:
    mesh = dented_ball(20 * 4**3)
    read = loaded(glb_of(mesh, 1024))
    np.testing.assert_allclose(np.asarray(read.vertices), mesh.vertices, atol=1e-7)
    np.testing.assert_array_equal(np.asarray(read.faces), mesh.faces)


def test_vertex_colours_are_linear_light_as_gltf_has_them() -> None:
    import json

    glb = glb_of(box((0.1, 0.1, 0.1), (0, 128, 255)), 1024)
    length = int.from_bytes(glb[12:16], "little")
    tree = json.loads(glb[20 : 20 + length])
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    view = tree["bufferViews"][accessor["bufferView"]]
    start = 20 + length + 8 + view["byteOffset"]
    values = np.frombuffer(glb[start : start + view["byteLength"]], "<u2").reshape(-1, 4)
    assert accessor["normalized"] and accessor["count"] == 8
    np.testing.assert_allclose(values[0] / 65535, [0, 0.2158605, 1, 1], atol=1e-5)


def test_a_texture_is_upright_and_no_larger_than_asked() -> None:
    read = loaded(glb_of(textured_square(), 32))
    image = np.asarray(read.visual.material.baseColorTexture.convert("RGB")).astype(int)
    assert image.shape[:2] == (32, 32)
    assert image[4, 16, 0] > 200 > image[4, 16, 2] and image[28, 16, 2] > 200
    # trimesh turns glTF's V back upwards: the corner of v = 1 is the red edge.
    np.testing.assert_allclose(np.asarray(read.visual.uv), textured_square().uv, atol=1e-6)
