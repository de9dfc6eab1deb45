"""Looks that cannot be read are named: a texture without texture coordinates."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from realsim.formats.bop.models import load_models, save_models
from realsim.geometry.parts import part
from realsim.models.mesh_loading import load_pieces

BOX = trimesh.creation.box((0.1, 0.1, 0.1))


def lines(form: str, rows: np.ndarray) -> str:
    return "".join(form % tuple(row) for row in rows)


def write(folder: Path, suffix: str) -> Path:
    """Write a box that names a texture and has no texture coordinates."""
    Image.new("RGB", (4, 4), (200, 10, 10)).save(folder / "t.png")
    path = folder / f"box.{suffix}"
    if suffix == "obj":
        (folder / "box.mtl").write_text("newmtl m\nKd 0.2 0.4 0.6\nmap_Kd t.png\n")
        path.write_text("mtllib box.mtl\nusemtl m\n" + lines("v %f %f %f\n", BOX.vertices)
                        + lines("f %d %d %d\n", BOX.faces + 1))  # fmt: skip
    elif suffix == "ply":
        path.write_text(
            "ply\nformat ascii 1.0\ncomment TextureFile t.png\nelement vertex 8\n"
            "property float x\nproperty float y\nproperty float z\nelement face 12\n"
            "property list uchar int vertex_indices\nend_header\n"
            + lines("%f %f %f\n", BOX.vertices) + lines("3 %d %d %d\n", BOX.faces)
        )  # fmt: skip
    else:
        mesh = BOX.copy()
        material = trimesh.visual.material.PBRMaterial(
            baseColorTexture=Image.open(folder / "t.png")
        )
        mesh.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
        data = mesh.export(file_type="glb")
        length = struct.unpack("<I", data[12:16])[0]
        header = json.loads(data[20 : 20 + length])
        del header["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 4)
        rest = data[20 + length :]
        path.write_bytes(
            struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
            + struct.pack("<I4s", len(text), b"JSON") + text + rest
        )  # fmt: skip
    return path


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb"])
def test_a_texture_without_coordinates_is_named(tmp_path: Path, suffix: str) -> None:
    content = load_pieces(write(tmp_path, suffix))
    assert all(p.image is None for p in content.pieces)
    told = [n for n in content.notes if "no texture coordinates" in n]
    assert len(told) == 1 and "Unwrap" in told[0]


def test_a_model_folder_tells_of_its_missing_texture_with_what_stands_for_it(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    mug = part("mug")
    save_models(tmp_path, {mug.obj_id: mug})
    file = next(tmp_path.glob("*.ply"))
    file.write_bytes(file.read_bytes().replace(
        b"element vertex", b"comment TextureFile gone.png\nelement vertex", 1))  # fmt: skip
    notes: list[str] = []
    load_models(tmp_path, notes=notes)
    assert len(notes) == 1 and "gone.png" in notes[0] and "stands for it" in notes[0]
    assert not [w for w in recwarn if "gone.png" in str(w.message)]
