"""Triangle meshes in files: reading any common format, writing PLY, and checking the unit.

`unit` names what the file holds; a claim that cannot be true is an error instead of a pot of 90
metres.
"""

import contextlib
import io
import logging
import re
import warnings
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, UInt8
from realsim.errors import InputError, UnitError
from realsim.geometry.mesh_shape import vertex_normals, welded_mesh
from realsim.records import Mesh

Unit = Literal["m", "mm"]

METRES: dict[str, float] = {"m": 1.0, "mm": 1e-3}
FORMATS = (".ply", ".obj", ".stl", ".glb")
SMALLEST_M = 0.002
"""A 'millimetre' file whose largest extent is below 2 mm holds metres: nothing that a gripper
grasps is so small."""
MOST_TEXELS = 100_000_000
"""Pixels of a texture; a header can claim any number, and decoders allocate what it claims."""
PLAIN_PLY = re.compile(
    rb"ply\nformat binary_little_endian 1\.0\nelement vertex (\d{1,9})\n"
    rb"property float x\nproperty float y\nproperty float z\n"
    rb"property float nx\nproperty float ny\nproperty float nz\n"
    rb"(property uchar red\nproperty uchar green\nproperty uchar blue\n)?"
    rb"element face (\d{1,9})\nproperty list uchar int vertex_indices\nend_header\n"
)
"""Header of what `ply_bytes` writes without texture: vertices, whether coloured, faces."""
PLACE = [("xyz", "<f4", 3), ("normal", "<f4", 3)]
TRIANGLE = np.dtype([("n", "u1"), ("v", "<i4", 3)])
LARGEST_M = 3.0
"""A 'metre' file whose largest extent is above 3 m holds millimetres: nothing on a table is so
large."""


def check_unit(largest_extent: float, unit: Unit, name: str) -> None:
    """Raise if a mesh of this largest extent (in its file's numbers) cannot be in that unit.

    Raises:
        UnitError: the extent is implausible; the message says what it would be in the other unit.
    """
    if unit not in METRES:
        raise UnitError(f"{name}: the unit '{unit}' is not known; 'm' and 'mm' are.")
    extent_m = largest_extent * METRES[unit]
    if unit == "mm" and extent_m < SMALLEST_M:
        raise UnitError(
            f"{name} is said to be in mm, but its largest extent is {largest_extent:.4g} mm; in "
            f"metres it would be {largest_extent:.4g} m. At least {SMALLEST_M * 1e3:g} mm is "
            "accepted. If it is in metres, `realsim scan import FILE --unit m` makes a model of it."
        )
    if unit == "m" and extent_m > LARGEST_M:
        raise UnitError(
            f"{name} is said to be in m, but its largest extent is {largest_extent:.4g} m; in "
            f"millimetres it would be {largest_extent:.4g} mm = {largest_extent / 1e3:.4g} m. At "
            f"most {LARGEST_M:g} m is accepted. If it is in millimetres, `realsim scan import FILE "
            "--unit mm` makes a model of it."
        )


def load_mesh(path: Path | str, unit: Unit, notes: list[str] | None = None) -> Mesh:
    """Read a ply, obj, stl or glb file as one mesh in metres.

    Textures, texture coordinates and vertex colours are kept. STL repeats every corner, so its
    equal vertices are merged; elsewhere vertices stay as they are in the file. A texture that the
    file names and that is missing, broken or without texture coordinates is left out and named,
    with what stands for it: the plain colour of the file's material, or none.

    Args:
        path: the file; the parts of a scene are merged.
        unit: what one unit of the file is.
        notes: what is missing is added to it; None = it is said as a Python warning.

    Raises:
        InputError: no such file, not a mesh, no triangles.
        UnitError: the size of the mesh contradicts the unit.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: '{path.suffix}' is not a mesh format; {', '.join(FORMATS)} are.")
    if not path.is_file():
        raise InputError(f"{path} does not exist; a mesh file was expected there.")
    plain = _plain_ply(path.read_bytes()) if path.suffix.lower() == ".ply" else None
    if plain is not None:
        check_unit(float(plain.extent.max()), unit, str(path))
        return replace(plain, vertices=plain.vertices * METRES[unit])
    import trimesh

    from realsim.interop import unbroken

    beside = _files_beside(path)
    try:
        with _quiet("trimesh"), unbroken():
            loaded: Any = trimesh.load_scene(path, process=False, resolver=beside).to_mesh()
    except Exception as error:  # a broken file raises whatever the format's reader trips over
        raise InputError(
            f"{path} cannot be read as a {path.suffix[1:]} mesh: it seems to be cut off or damaged."
            " Copy or export it again; triangles with vertices are needed."
        ) from error
    vertices = np.asarray(getattr(loaded, "vertices", ()), dtype=np.float64).reshape(-1, 3)
    faces = np.asarray(getattr(loaded, "faces", ()), dtype=np.int32).reshape(-1, 3)
    if len(faces) == 0:
        raise InputError(
            f"{path} has {len(vertices)} vertices and no triangles; a surface mesh is needed, "
            "not a point cloud. Is the file whole?"
        )
    check_unit(float(np.ptp(vertices, axis=0).max()), unit, str(path))
    colors, uv, texture = _appearance(loaded, len(vertices), beside.broken)
    has_pictures = bool(beside.pictures) or path.suffix.lower() == ".glb"
    if texture is not None and not has_pictures:
        # The reader makes a grey picture up where the file's own is missing.
        texture = None
    if (
        colors is not None
        and loaded.visual.kind == "texture"
        and not (has_pictures or beside.tables or path.suffix.lower() == ".glb")
    ):
        colors = None
    told = _missing_looks(path, beside, colors, texture)
    if notes is not None:
        notes += told
    else:
        for words in told:
            warnings.warn(words, stacklevel=2)
    mesh = Mesh(
        vertices=vertices * METRES[unit], faces=faces, colors=colors, uv=uv, texture=texture
    )
    return welded_mesh(mesh) if path.suffix.lower() == ".stl" else mesh


def _plain_ply(data: bytes) -> Mesh | None:
    """Return the mesh of a file as `ply_bytes` writes it without texture, in the file's unit.

    None = it is for the general reader, whose import alone takes longer than ten such files.
    """
    found = PLAIN_PLY.match(data)
    if found is None:
        return None
    vertex = np.dtype([*PLACE, ("rgb", "u1", 3)] if found[2] else PLACE)
    vertices, faces, start = int(found[1]), int(found[3]), found.end()
    middle = start + vertices * vertex.itemsize
    if not faces or len(data) != middle + faces * TRIANGLE.itemsize:
        return None
    table = np.frombuffer(data, vertex, vertices, start)
    triangles = np.frombuffer(data, TRIANGLE, faces, middle)
    corners = triangles["v"]
    if (triangles["n"] != 3).any() or corners.min() < 0 or corners.max() >= vertices:
        return None
    return Mesh(
        vertices=table["xyz"].astype(np.float64),
        faces=corners,
        colors=table["rgb"] if found[2] else None,
    )


def _files_beside(path: Path) -> Any:
    """Return a trimesh resolver that remembers which files the mesh file asked for."""
    from trimesh.resolvers import FilePathResolver

    class Beside(FilePathResolver):
        def __init__(self, source: str) -> None:
            super().__init__(source)
            self.missing: list[str] = []
            self.broken: list[str] = []
            self.pictures: list[str] = []
            self.tables: list[str] = []

        def get(self, name: str) -> bytes:
            try:
                data: bytes = super().get(name)
            except OSError:
                self.missing.append(name)
                raise
            if name.lower().endswith((".mtl", ".bin")):
                self.tables.append(name)
            elif _is_picture(data):
                self.pictures.append(name)
            else:
                self.broken.append(name)
            return data

    return Beside(str(path))


def _is_picture(data: bytes) -> bool:
    """Return whether bytes are a picture that can be decoded."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as image:
            if image.width * image.height > MOST_TEXELS:
                return False
            image.load()
    except Exception:  # a broken picture raises whatever its decoder trips over
        return False
    return True


@contextlib.contextmanager
def _quiet(name: str) -> Generator[None]:
    """Keep a library from printing tracebacks of what is reported in words here."""
    log = logging.getLogger(name)
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        log.setLevel(level)


def _missing_looks(
    path: Path, beside: Any, colors: UInt8 | None, texture: UInt8 | None
) -> list[str]:
    """Return in words what is missing of a mesh's look, and what stands for it."""
    if texture is not None:
        instead = "the plain colour of its part stands for it"
    elif colors is not None:
        r, g, b = colors[0].tolist()
        instead = f"the material's plain colour stands for it (sRGB {r} {g} {b})"
    else:
        instead = "the mesh has no colours; renderings paint it, or give it a procedural material"
    told = [
        f"{path}: '{name}', named in it, is not in its folder; {instead}. Put the file there."
        for name in dict.fromkeys(beside.missing)
    ]
    told += [
        f"{path}: '{name}', named in it, cannot be decoded as a picture; {instead}. Save it again."
        for name in dict.fromkeys(beside.broken)
    ]
    if beside.pictures and texture is None:
        told.append(
            f"{path} names the texture '{beside.pictures[0]}', but has no texture coordinates; "
            f"{instead}. Unwrap the mesh and export it again."
        )
    return told


def _appearance(
    loaded: Any, n: int, broken: list[str]
) -> tuple[UInt8 | None, Array | None, UInt8 | None]:
    """Return colours, texture coordinates and texture of a trimesh mesh, where it has them.

    A texture that cannot be decoded is added to `broken`.
    """
    visual = loaded.visual
    if visual.kind == "texture":
        material = visual.material
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        has_uv = visual.uv is not None and len(visual.uv) == n
        texture = _texels(image, broken) if image is not None and has_uv else None
        if texture is not None:
            return None, np.asarray(visual.uv, dtype=np.float64)[:, :2], texture
        color = np.asarray(material.main_color, dtype=np.uint8)[:3]
        return np.tile(color, (n, 1)), None, None
    if visual.kind in ("vertex", "face"):
        return np.asarray(visual.vertex_colors, dtype=np.uint8)[:, :3], None, None
    return None, None, None


def _texels(image: Any, broken: list[str]) -> UInt8 | None:
    """Return a picture that lies in the mesh file, or was opened by its reader, as RGB."""
    try:
        if image.width * image.height > MOST_TEXELS:
            raise ValueError(f"{image.width}x{image.height} pixels")
        return np.asarray(image.convert("RGB"), dtype=np.uint8)
    except Exception:  # pillow decodes late: a broken picture shows only here
        broken.append("the texture of its material")
        return None


def ply_bytes(mesh: Mesh, unit: Unit, *, ascii: bool = False, texture_file: str = "") -> bytes:
    """Return the mesh as the bytes of a PLY file with normals, as BOP's models have them.

    Args:
        mesh: the mesh [m]; its colours and texture coordinates are written where it has them.
        unit: unit of the file; BOP's is mm.
        ascii: text instead of little-endian binary.
        texture_file: name of the texture beside it, noted as BOP does it.
    """
    columns: list[tuple[str, str, NDArray[Any]]] = []
    xyz = mesh.vertices / METRES[unit]
    columns += [(name, "<f4", xyz[:, i]) for i, name in enumerate("xyz")]
    normals = vertex_normals(mesh)
    columns += [(name, "<f4", normals[:, i]) for i, name in enumerate(("nx", "ny", "nz"))]
    if mesh.uv is not None:
        columns += [("texture_u", "<f4", mesh.uv[:, 0]), ("texture_v", "<f4", mesh.uv[:, 1])]
    if mesh.colors is not None:
        names = ("red", "green", "blue")
        columns += [(name, "u1", mesh.colors[:, i]) for i, name in enumerate(names)]
    types = {"<f4": "float", "u1": "uchar"}
    lines = ["ply", f"format {'ascii' if ascii else 'binary_little_endian'} 1.0"]
    lines += [f"comment TextureFile {texture_file}"] if texture_file else []
    lines += [f"element vertex {len(xyz)}"]
    lines += [f"property {types[kind]} {name}" for name, kind, _ in columns]
    lines += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices"]
    header = "\n".join([*lines, "end_header", ""]).encode("ascii")
    table = np.empty(len(xyz), dtype=[(name, kind) for name, kind, _ in columns])
    for name, _, values in columns:
        table[name] = values
    if ascii:
        # 9 digits bring every float32 back exactly.
        rows = [" ".join(f"{v:.9g}" for v in row.tolist()) for row in table]
        rows += [f"3 {a} {b} {c}" for a, b, c in mesh.faces.tolist()]
        return header + ("\n".join(rows) + "\n").encode("ascii")
    triangles = np.empty(len(mesh.faces), dtype=TRIANGLE)
    triangles["n"], triangles["v"] = 3, mesh.faces
    return header + table.tobytes() + triangles.tobytes()


def save_ply(path: Path | str, mesh: Mesh, unit: Unit, *, ascii: bool = False) -> None:
    """Write the mesh as PLY, its texture beside it as a PNG of the same name."""
    path = Path(path)
    texture_file = path.with_suffix(".png").name if mesh.texture is not None else ""
    if mesh.texture is not None:
        import cv2

        cv2.imwrite(str(path.with_suffix(".png")), mesh.texture[..., ::-1])
    path.write_bytes(ply_bytes(mesh, unit, ascii=ascii, texture_file=texture_file))
