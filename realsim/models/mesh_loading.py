"""The pieces of glTF, OBJ, PLY, STL and OFF files, read by trimesh."""

import json
import struct
from dataclasses import replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any
from urllib.parse import unquote

import numpy as np

from realsim.errors import InputError
from realsim.geometry.mesh_files import MOST_TEXELS
from realsim.interop import unbroken
from realsim.models import mesh_atlas
from realsim.untrusted.files import require_permission

GLTF_FORMATS = (".glb", ".gltf")
TRIMESH_FORMATS = (*GLTF_FORMATS, ".obj", ".ply", ".stl", ".off")
GLB_JSON = 0x4E4F534A
"""Type of a GLB file's first chunk: 'JSON' in ASCII, little-endian."""
PACKED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")
"""Packed geometry that cannot be unpacked here."""
HEADER_BYTES = 4096
"""Length of a text header that is read for what the file says of itself."""


def load_pieces(path: Path) -> mesh_atlas.FileContent:
    """Return the pieces of a file with their nodes' transforms applied, and what it says.

    Raises:
        InputError: the file is broken, empty, a cloud of points, packed in a way that cannot be
            read, or names a file outside its folder.
    """
    import trimesh

    require_permission(path)
    kind = path.suffix.lower()
    notes: list[str] = []
    header = _gltf_header(path) if kind in GLTF_FORMATS else {}
    declared = _declared(path, kind, header)
    folder = _folder(path)
    try:
        with unbroken():
            scene: Any = trimesh.load_scene(path, process=False, resolver=folder)
            folder.raise_if_refused()
            pieces = _pieces(scene, kind, folder, header, notes)
    except InputError:
        raise
    except Exception as error:  # a broken file raises whatever the format's reader trips over
        folder.raise_if_refused()
        missing = f" It names {', '.join(folder.missing)}, not found." if folder.missing else ""
        raise InputError(
            f"{path} cannot be read as a {kind[1:]} mesh: it seems to be cut off or damaged."
            f"{missing} Copy or export it again; triangles with vertices are needed."
        ) from error
    notes += [
        f"'{name}', named in the file, is not in its folder: colours from it are missing."
        for name in folder.missing
    ]
    pictures = [n for n in folder.found if not n.lower().endswith((".mtl", ".bin"))]
    if pictures and kind == ".ply" and all(p.image is None for p in pieces):
        notes.append(_without_coordinates(f"the texture '{pictures[0]}'"))
    is_gltf = kind in GLTF_FORMATS
    return mesh_atlas.FileContent(
        pieces=tuple(pieces),
        declared=declared,
        notes=tuple(notes),
        up="y" if is_gltf else None,
        format_unit="m" if is_gltf else None,
    )


def escapes(name: str) -> bool:
    """Return whether a file name inside a mesh file leads out of the mesh file's folder."""
    plain = name.replace("\\", "/").strip()
    depth = 0
    for part in PurePosixPath(plain).parts:
        depth += {"..": -1, ".": 0}.get(part, 1)
        if depth < 0:
            return True
    return plain.startswith(("/", "~")) or PureWindowsPath(plain).is_absolute() or "://" in plain


def escape_error(path: Path, names: list[str]) -> InputError:
    """Return the error for a file that names files outside its folder."""
    return InputError(
        f"{path} names {', '.join(repr(n) for n in names)}, outside its own folder; a mesh file "
        "may only read what lies beside or below it. Put the files there, and name them by "
        "relative paths."
    )


def _folder(path: Path) -> Any:
    """Return a trimesh resolver that stays in the file's folder and remembers what it was asked."""
    from trimesh.resolvers import FilePathResolver

    class Folder(FilePathResolver):
        def __init__(self, source: str) -> None:
            super().__init__(source)
            self.missing: list[str] = []
            self.refused: list[str] = []
            self.found: list[str] = []

        def get(self, name: str) -> bytes:
            plain = unquote(name).replace("\\", "/").strip()
            root = Path(self.parent).resolve()
            target = (root / plain).resolve()
            if escapes(plain) or not target.is_relative_to(root):
                self.refused.append(name)
                raise FileNotFoundError(name)
            if not target.is_file():
                self.missing.append(name)
                raise FileNotFoundError(name)
            self.found.append(name)
            return target.read_bytes()

        def raise_if_refused(self) -> None:
            if self.refused:
                raise escape_error(path, self.refused)

    return Folder(str(path))


def _pieces(
    scene: Any, kind: str, folder: Any, header: dict[str, Any], notes: list[str]
) -> list[mesh_atlas.Piece]:
    """Return the pieces of a trimesh scene, every node placed by its transform."""
    pieces: list[mesh_atlas.Piece] = []
    others = 0
    transforms = _texture_transforms(header, notes)
    known: dict[str, mesh_atlas.Piece] = {}
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        geometry = scene.geometry[name]
        faces = np.asarray(getattr(geometry, "faces", ()), dtype=np.int32).reshape(-1, 3)
        if len(faces) == 0:
            others += 1
            continue
        if name not in known:
            known[name] = _piece(str(name), geometry, faces, kind, folder, transforms, notes)
        piece, is_mirrored = mesh_atlas.placed(known[name], matrix)
        if is_mirrored:
            notes.append(
                f"node '{node}' is mirrored by its transform; its faces were turned so that the "
                "outside stays outside."
            )
        pieces.append(piece)
    if others and pieces:
        notes.append(f"{others} parts without triangles (points or lines) were left out.")
    return pieces


def _piece(
    name: str,
    geometry: Any,
    faces: Any,
    kind: str,
    folder: Any,
    transforms: dict[str, tuple[Any, float, Any]],
    notes: list[str],
) -> mesh_atlas.Piece:
    """Return one trimesh mesh with its colours, in its own coordinates."""
    vertices = np.asarray(geometry.vertices, dtype=np.float64).reshape(-1, 3)
    piece = mesh_atlas.Piece(name=name, vertices=vertices, faces=faces)
    visual = geometry.visual
    if visual.kind in ("vertex", "face"):
        colors = np.asarray(visual.vertex_colors, dtype=np.uint8)[:, :3]
        return replace(piece, colors=colors) if len(colors) == len(vertices) else piece
    if visual.kind != "texture":
        return piece
    material = visual.material
    is_gltf = kind in GLTF_FORMATS
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    factor = getattr(material, "baseColorFactor", None)
    linear = None if factor is None else np.asarray(factor, dtype=np.float64)[:3] / 255.0
    uv = None if visual.uv is None else np.asarray(visual.uv, dtype=np.float64)[:, :2]
    if image is not None and uv is not None and len(uv) == len(vertices):
        try:
            if image.width * image.height > MOST_TEXELS:
                raise ValueError(f"it claims {image.width}x{image.height} pixels")
            texture = mesh_atlas.image_array(image)
        except Exception as error:  # pillow decodes late: a broken or huge picture shows only here
            notes.append(f"the texture of '{name}' cannot be decoded ({error}); it is left out.")
        else:
            if material.name in transforms:
                uv = mesh_atlas.transformed_uv(uv, *transforms[material.name], v_down=True)
            tint = tuple((linear if linear is not None else np.ones(3)).tolist())
            key = (id(image), tint)
            return replace(piece, uv=uv, image=mesh_atlas.tinted(texture, tint), image_key=key)
    elif image is not None:
        notes.append(_without_coordinates(f"the texture of '{name}'"))
    if is_gltf:
        return replace(piece, color=None if linear is None else mesh_atlas.rgb8(linear))
    if not folder.found:  # trimesh makes a material up where the file's own is missing
        return piece
    r, g, b = np.asarray(material.main_color, dtype=int)[:3].tolist()
    return replace(piece, color=(r, g, b))


def _without_coordinates(what: str) -> str:
    """Return the note on a texture that cannot be laid on its mesh."""
    return (
        f"{what} cannot be laid on the mesh, which has no texture coordinates: it is left out, and "
        "a plain colour stands for it where the file has one. Unwrap the mesh and export it again."
    )


def _gltf_header(path: Path) -> dict[str, Any]:
    """Return the JSON part of a glTF file.

    Raises:
        InputError: it is broken, or its geometry is packed.
    """
    try:
        with path.open("rb") as file:
            if path.suffix.lower() == ".glb":
                magic, _, _, length, kind = struct.unpack("<4sIIII", file.read(20))
                if magic != b"glTF" or kind != GLB_JSON:
                    raise ValueError("it does not begin with 'glTF' and a JSON chunk")
                header = json.loads(file.read(length))
            else:
                header = json.loads(file.read())
        if not isinstance(header, dict):
            raise ValueError("its JSON is not an object")
    except (ValueError, struct.error) as error:
        raise InputError(
            f"{path} cannot be read as a {path.suffix[1:]} mesh ({error}). Export it again."
        ) from error
    packed = [e for e in header.get("extensionsRequired", ()) if e in PACKED]
    if packed:
        raise InputError(
            f"{path} needs {', '.join(packed)} to be unpacked, which is not supported. Export it "
            "without mesh compression."
        )
    return header


def _texture_transforms(
    header: dict[str, Any], notes: list[str]
) -> dict[str, tuple[Any, float, Any]]:
    """Return offset, rotation and scale of the base texture by the name of the material."""
    out: dict[str, tuple[Any, float, Any]] = {}
    materials: list[dict[str, Any]] = header.get("materials", [])
    names = [str(m.get("name", "")) for m in materials]
    for material, name in zip(materials, names, strict=True):
        base = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
        found = base.get("extensions", {}).get("KHR_texture_transform")
        if base.get("texCoord", 0) or (found or {}).get("texCoord", 0):
            notes.append(f"material '{name}' uses a second set of texture coordinates: not read.")
        if found is None:
            continue
        if names.count(name) > 1 or not name:
            notes.append(
                f"the texture transform of material '{name}' was not applied: its name "
                "is not its own."
            )
            continue
        rotation = float(found.get("rotation", 0.0))
        out[name] = (found.get("offset", (0.0, 0.0)), rotation, found.get("scale", (1.0, 1.0)))
    for key, what in (("skins", "a skeleton"), ("animations", "animations")):
        if header.get(key):
            notes.append(f"the file has {what}; the shape at rest is read.")
    return out


def _declared(path: Path, kind: str, header: dict[str, Any]) -> dict[str, str]:
    """Return what the file says of itself."""
    declared = {"format": kind[1:]}
    if kind in GLTF_FORMATS:
        asset = header.get("asset", {})
        declared |= {k: str(asset[k]) for k in ("generator", "version", "copyright") if k in asset}
        declared |= {"unit": "m (prescribed by glTF)", "up": "y (prescribed by glTF)"}
        return declared
    with path.open("rb") as file:
        head = file.read(HEADER_BYTES)
    if kind == ".stl":
        text = head[:80].split(b"\n")[0]
    else:
        mark = b"comment" if kind == ".ply" else b"#"
        head = head.split(b"end_header")[0]
        lines = [line.strip() for line in head.split(b"\n") if line.strip().startswith(mark)]
        text = b"; ".join(line[len(mark) :].strip() for line in lines[:4])
    plain = "".join(c for c in text.decode("ascii", "replace") if c.isprintable()).strip(" \ufffd")
    return declared | ({"header": plain} if plain else {})
