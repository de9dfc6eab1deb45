"""The CAD parts that ship with the package, as object models at metric scale.

Each is a watertight, painted mesh in metres with its exact symmetries, 4 to 16 cm long, most of
them graspable by an 80 mm gripper. The ids are fixed for ever: a stored scene names them.
"""

import importlib.util
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array
from realsim.errors import InputError, MissingLibraryError
from realsim.geometry import parts_prismatic as prismatic
from realsim.geometry import parts_turned as turned
from realsim.geometry.parts_prismatic import PartShape
from realsim.geometry.parts_solids import weld
from realsim.records import Mesh, ObjectModel

_PARTS: dict[str, tuple[int, Callable[[], PartShape]]] = {
    "box": (1, prismatic.box),
    "cube": (2, prismatic.cube),
    "hex_nut": (3, prismatic.hex_nut),
    "cylinder_can": (4, turned.cylinder_can),
    "l_bracket": (5, prismatic.l_bracket),
    "t_profile": (6, prismatic.t_profile),
    "gear": (7, prismatic.gear),
    "wedge": (8, prismatic.wedge),
    "tube": (9, turned.tube),
    "mug": (10, turned.mug),
    "bottle": (11, turned.bottle),
    "bowl": (12, turned.bowl),
    "flange": (13, prismatic.flange),
    "pulley": (14, turned.pulley),
    "knob": (15, prismatic.knob),
    "stepped_shaft": (16, turned.stepped_shaft),
    "capsule": (17, turned.capsule),
    "u_channel": (18, prismatic.u_channel),
    "cone": (19, turned.cone),
    "elbow": (20, turned.elbow),
}

_BULLET: dict[int, tuple[str, str, Literal["m", "mm"], float, tuple[int, int, int]]] = {
    # id: (name, file in pybullet_data, unit in which its numbers are plausible, factor to its real
    # size, RGB where the file has no texture). The factors of the duck and of the random objects
    # are those of their URDFs.
    101: ("duck", "duck.obj", "m", 0.05, (230, 200, 60)),
    102: ("bunny", "bunny.obj", "m", 0.045, (150, 120, 96)),
    103: ("teddy", "teddy2_VHACD_CHs.obj", "m", 0.09, (156, 98, 58)),
    104: ("blob_000", "random_urdfs/000/000.obj", "mm", 15.0, (70, 96, 178)),
    105: ("blob_004", "random_urdfs/004/004.obj", "mm", 15.0, (60, 140, 96)),
    106: ("blob_017", "random_urdfs/017/017.obj", "mm", 15.0, (186, 72, 90)),
    107: ("blob_025", "random_urdfs/025/025.obj", "mm", 15.0, (206, 146, 52)),
    108: ("blob_033", "random_urdfs/033/033.obj", "mm", 15.0, (122, 84, 160)),
}


def part_names() -> tuple[str, ...]:
    """Return the names of all parts, in the order of their ids."""
    return tuple(_PARTS)


def _painted(
    vertices: Array, bands: Sequence[tuple[float, tuple[int, int, int]]]
) -> NDArray[np.uint8]:
    """Return the RGB (V, 3) of the band that each vertex's height falls into."""
    limits = np.array([upper for upper, _ in bands])
    palette = np.array([color for _, color in bands], dtype=np.uint8)
    return palette[np.searchsorted(limits[:-1], vertices[:, 2])]


@cache
def part(name: str) -> ObjectModel:
    """Return a part of the shipped set.

    Raises:
        InputError: there is no part of this name.
    """
    if name not in _PARTS:
        raise InputError(f"there is no part '{name}'; there are: {', '.join(_PARTS)}.")
    obj_id, build = _PARTS[name]
    shape = build()
    vertices, faces = weld(shape.pieces)
    return ObjectModel(
        obj_id=obj_id,
        name=name,
        mesh=Mesh(vertices=vertices, faces=faces, colors=_painted(vertices, shape.bands)),
        symmetries=shape.symmetries,
        symmetry_axes=(((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),) if shape.turns_about_z else (),
    )


def object_names() -> tuple[str, ...]:
    """Return the names of all objects at hand: the shipped parts, then PyBullet's meshes."""
    return (*_PARTS, *(entry[0] for entry in _BULLET.values()))


def object_model(name: str) -> ObjectModel:
    """Return a shipped part or one of PyBullet's meshes by its name.

    Raises:
        InputError: neither has this name.
        MissingLibraryError: it is PyBullet's, and pybullet_data is not installed.
    """
    if name in _PARTS:
        return part(name)
    for obj_id, entry in _BULLET.items():
        if entry[0] == name:
            return pybullet_models([obj_id])[0]
    raise InputError(f"there is no object '{name}'; there are: {', '.join(object_names())}.")


def pybullet_models(ids: Sequence[int]) -> tuple[ObjectModel, ...]:
    """Return object models of meshes that come with PyBullet; PyBullet itself is not imported.

    Args:
        ids: obj_ids; a wrong one is answered with those that there are.

    Raises:
        InputError: an id is not known.
        MissingLibraryError: pybullet_data is not installed.
    """
    spec = importlib.util.find_spec("pybullet_data")
    if spec is None or spec.origin is None:
        raise MissingLibraryError(
            "pybullet_data is not installed, so its meshes cannot be read; install pybullet, or "
            f"use the shipped parts: {', '.join(_PARTS)}."
        )
    folder = Path(spec.origin).parent
    return tuple(_pybullet_model(folder, obj_id) for obj_id in ids)


@cache
def _pybullet_model(folder: Path, obj_id: int) -> ObjectModel:
    from realsim.geometry.mesh import load_mesh

    if obj_id not in _BULLET:
        raise InputError(
            f"{obj_id} is not the id of a pybullet_data mesh; the ids are: "
            f"{', '.join(f'{i} ({v[0]})' for i, v in _BULLET.items())}."
        )
    name, file, unit, factor, color = _BULLET[obj_id]
    # What is missing of the file's look is not told: the colour of the list stands for it.
    raw = load_mesh(folder / file, unit, notes=[])
    vertices = raw.vertices * factor
    vertices = vertices - (vertices.min(0) + vertices.max(0)) / 2
    if raw.texture is not None and raw.uv is not None:
        mesh = Mesh(vertices=vertices, faces=raw.faces, uv=raw.uv, texture=raw.texture)
    else:
        painted = np.tile(np.array(color, dtype=np.uint8), (len(vertices), 1))
        mesh = Mesh(vertices=vertices, faces=raw.faces, colors=painted)
    return ObjectModel(obj_id=obj_id, name=name, mesh=mesh)
