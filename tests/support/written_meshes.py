"""Meshes with textures, and files of them as other programs write them."""

import numpy as np
import trimesh
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from realsim.records import Mesh


def colorful_texture(n=32, seed=0):
    """Blocks of 4 x 4 texels, so that a texel's neighbour is rarely of another colour."""
    blocks = np.random.default_rng(seed).integers(0, 256, (n // 4, n // 4, 3), dtype=np.uint8)
    return blocks.repeat(4, axis=0).repeat(4, axis=1)


def textured_box(extents=(0.1, 0.06, 0.04), seed=0):
    """A closed box whose six sides are six charts of one texture."""
    solid = trimesh.creation.box(extents)
    vertices, faces, uv = [], [], []
    normals = np.asarray(solid.face_normals)
    for side in range(6):
        axis, sign = side % 3, 1 if side < 3 else -1
        mine = solid.faces[normals[:, axis] * sign > 0.5]
        corners = np.unique(mine)
        points = solid.vertices[corners]
        flat = np.delete((points > 0).astype(float), axis, axis=1)
        cell = np.array([side % 3, side // 3])
        uv.append((cell + 0.05 + 0.9 * flat) / [3, 2])
        faces.append(np.searchsorted(corners, mine) + 4 * side)
        vertices.append(points)
    return Mesh(
        vertices=np.concatenate(vertices), faces=np.concatenate(faces), uv=np.concatenate(uv),
        texture=colorful_texture(seed=seed),
    )  # fmt: skip


def as_trimesh(mesh):
    solid = trimesh.Trimesh(mesh.vertices.copy(), mesh.faces.copy(), process=False)
    if mesh.texture is not None:
        material = trimesh.visual.material.PBRMaterial(
            baseColorTexture=Image.fromarray(mesh.texture.copy()),
            baseColorFactor=[255, 255, 255, 255],
        )
        solid.visual = trimesh.visual.TextureVisuals(uv=mesh.uv.copy(), material=material)
    elif mesh.colors is not None:
        solid.visual = trimesh.visual.ColorVisuals(solid, vertex_colors=mesh.colors.copy())
    return solid


def write_gltf(path, mesh, *, with_picture=True):
    """Write a mesh as glTF in several files, or without the picture that it names."""
    for name, data in as_trimesh(mesh).export(file_type="gltf").items():
        if with_picture or not name.endswith((".png", ".jpg", ".jpeg")):
            (path if name.endswith(".gltf") else path.parent / name).write_bytes(data)


def write_textured_obj(path, mesh, texture_name="skin.png"):
    Image.fromarray(mesh.texture.copy()).save(path.parent / "skin.png")
    path.with_suffix(".mtl").write_text(f"newmtl skin\nKd 0.4 0.4 0.4\nmap_Kd {texture_name}\n")
    lines = [f"mtllib {path.with_suffix('.mtl').name}", "usemtl skin"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices]
    lines += [f"vt {u:.9g} {v:.9g}" for u, v in mesh.uv]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in mesh.faces]
    path.write_text("\n".join(lines) + "\n")


def write_usd(path, mesh, *, metres=1.0, up="Z", texture="skin.png"):
    """Write a mesh with a UsdPreviewSurface; faceVarying coordinates, as exporters do."""
    stage = Usd.Stage.CreateNew(str(path))
    if metres is not None:
        UsdGeom.SetStageMetersPerUnit(stage, metres)
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.Xform.Define(stage, "/thing")
    shape = UsdGeom.Mesh.Define(stage, "/thing/shape")
    shape.CreatePointsAttr([Gf.Vec3f(*map(float, v)) for v in mesh.vertices])
    shape.CreateFaceVertexCountsAttr([3] * len(mesh.faces))
    shape.CreateFaceVertexIndicesAttr(mesh.faces.ravel().tolist())
    shape.CreateSubdivisionSchemeAttr("none")
    if mesh.texture is not None:
        Image.fromarray(mesh.texture.copy()).save(path.parent / "skin.png")
        api = UsdGeom.PrimvarsAPI(shape)
        uv = api.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
        uv.Set([Gf.Vec2f(*map(float, x)) for x in mesh.uv[mesh.faces.ravel()]])
        material = UsdShade.Material.Define(stage, "/thing/skin")
        surface = UsdShade.Shader.Define(stage, "/thing/skin/surface")
        surface.CreateIdAttr("UsdPreviewSurface")
        picture = UsdShade.Shader.Define(stage, "/thing/skin/picture")
        picture.CreateIdAttr("UsdUVTexture")
        picture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(texture)
        reader = UsdShade.Shader.Define(stage, "/thing/skin/reader")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        picture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(
            reader.ConnectableAPI(), "result"
        )
        surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(
            picture.ConnectableAPI(), "rgb"
        )
        material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
        UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)
    stage.GetRootLayer().Save()
    return stage
