"""Object models as BOP keeps them: obj_%06d.ply in millimetres and models_info.json."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from realsim import images
from realsim.arrays import Array
from realsim.errors import InputError, UnitError
from realsim.geometry import se3
from realsim.geometry.mesh import diameter, load_mesh, ply_bytes
from realsim.records import Mesh, ObjectModel
from realsim.records.bop_units import MM_PER_M, flat
from realsim.store import atomic
from realsim.untrusted.json_text import read_json
from realsim.untrusted.values import mapping, number, numbers, text

INFO_FILE = "models_info.json"
LARGEST_DIAMETER_M = 3.0
"""An object on a table is smaller: a larger one was read in the wrong unit."""
UNIT_RATIO = 100.0
"""Diameters of the mesh and of models_info.json that differ by more than this have two units;
decimated or re-measured meshes differ by a few per cent."""


def model_file(obj_id: int) -> str:
    """Return the name of a model's mesh."""
    return f"obj_{obj_id:06d}.ply"


def save_models(folder: Path | str, models: Mapping[int, ObjectModel]) -> None:
    """Write models as BOP does: meshes [mm], textures beside them, then models_info.json.

    Name and density, which BOP has no keys for, are added to models_info.json; BOP's readers take
    the keys they know.

    Raises:
        InputError: a key is not the id of its model.
    """
    folder = Path(folder)
    info: dict[str, Any] = {}
    for obj_id in sorted(models):
        model = models[obj_id]
        if model.obj_id != obj_id:
            raise InputError(f"model '{model.name}' has the id {model.obj_id}, not {obj_id}.")
        for name, data in model_files(model).items():
            atomic.write_bytes(folder / name, data)
        info[str(obj_id)] = info_of(model)
    # Last: a folder with models_info.json is complete.
    atomic.write_json(folder / INFO_FILE, info)


def model_files(model: ObjectModel) -> dict[str, bytes]:
    """Return the files of a model in a models folder: its texture, where it has one, and mesh."""
    mesh_file, files = model_file(model.obj_id), dict[str, bytes]()
    texture_file = ""
    if model.mesh.texture is not None:
        texture_file = Path(mesh_file).with_suffix(".png").name
        files[texture_file] = images.png_bytes(model.mesh.texture)
    return files | {mesh_file: ply_bytes(model.mesh, "mm", texture_file=texture_file)}


def info_of(model: ObjectModel) -> dict[str, Any]:
    """Return the entry of a model in models_info.json."""
    low_mm = model.mesh.bounds[0] * MM_PER_M
    size_mm = model.mesh.extent * MM_PER_M
    info: dict[str, Any] = {"diameter": diameter(model.mesh) * MM_PER_M}
    info |= {f"min_{axis}": float(low_mm[i]) for i, axis in enumerate("xyz")}
    info |= {f"size_{axis}": float(size_mm[i]) for i, axis in enumerate("xyz")}
    discrete = [_matrix_mm(S) for S in model.symmetries if not np.allclose(S, np.eye(4))]
    if discrete:
        info["symmetries_discrete"] = discrete
    if model.symmetry_axes:
        info["symmetries_continuous"] = [
            {"axis": list(axis), "offset": [x * MM_PER_M for x in point]}
            for axis, point in model.symmetry_axes
        ]
    return info | {"name": model.name, "density": model.density}


def _matrix_mm(S: Array) -> list[float]:
    S = S.copy()
    S[:3, 3] *= MM_PER_M
    numbers: list[float] = S.ravel().tolist()
    return numbers


def load_models(
    folder: Path | str, obj_ids: Collection[int] | None = None, *, notes: list[str] | None = None
) -> dict[int, ObjectModel]:
    """Return the models of a BOP models folder, in metres.

    Args:
        folder: holds obj_%06d.ply and models_info.json.
        obj_ids: only these; None = all.
        notes: what is missing of a model's look is added to it; None = it is said as a Python
            warning.

    Raises:
        InputError: no models there, an id without mesh, or broken files.
        UnitError: a mesh is not in millimetres.
    """
    folder = Path(folder)
    files = {int(p.stem[4:]): p for p in folder.glob("obj_*.ply") if p.stem[4:].isdecimal()}
    if not files:
        found = "has no models" if folder.is_dir() else "does not exist"
        raise InputError(
            f"{folder} {found}; files obj_000001.ply, obj_000002.ply, ... are expected, as "
            "in the folder 'models' of a BOP dataset. If the models lie elsewhere, name their "
            "folder by --models FOLDER (for a session: run `realsim import` again with it)."
        )
    if not (folder / INFO_FILE).is_file():
        raise InputError(
            f"{folder} has meshes but no {INFO_FILE}, so their symmetries are not known. Write one "
            'with a diameter [mm] per object, e.g. {"1": {"diameter": 172.1}}.'
        )
    info = mapping(read_json(folder / INFO_FILE), str(folder / INFO_FILE))
    require_meshes(files if obj_ids is None else obj_ids, files, str(folder))
    return {
        i: _load_model(i, files[i], _row_of(info, i, folder / INFO_FILE), notes)
        for i in sorted(files if obj_ids is None else obj_ids)
    }


def require_meshes(wanted: Collection[int], present: Collection[int], where: str) -> None:
    """Raise if an object id has no mesh.

    Raises:
        InputError: names the ids that are missing and those that are there.
    """
    missing = sorted(set(wanted) - set(present))
    if missing:
        raise InputError(
            f"object {', '.join(map(str, missing))} has no mesh in {where}; there are "
            f"{', '.join(map(str, sorted(present))) or 'none'}. Add {model_file(missing[0])}, give "
            f"a folder that has it (--models FOLDER, with {INFO_FILE}), or leave these objects out."
        )


def _row_of(info: Mapping[str, Any], obj_id: int, path: Path) -> dict[str, Any]:
    return mapping(info.get(str(obj_id), {}), f"object {obj_id} of {path}")


def _load_model(
    obj_id: int, file: Path, info: dict[str, Any], notes: list[str] | None
) -> ObjectModel:
    mesh = load_mesh(file, "mm", notes)
    where = f"object {obj_id} of {file.parent / INFO_FILE}"
    _check_diameter(mesh, info, file)
    symmetries = [np.eye(4)]
    for k, given in enumerate(_listed(info, "symmetries_discrete", where)):
        name = f"discrete symmetry {k} of {where}"
        S = numbers(flat(given), 16, name).reshape(4, 4).copy()
        S[:3, 3] /= MM_PER_M
        symmetries.append(se3.check_rigid(S, name))
    axes: list[tuple[tuple[float, float, float], tuple[float, float, float]]] = []
    for k, given in enumerate(_listed(info, "symmetries_continuous", where)):
        name = f"continuous symmetry {k} of {where}"
        row = mapping(given, name)
        axis = _three(row.get("axis"), 1.0, f"axis of {name}")
        if not any(axis):
            raise InputError(f"axis of {name} is 0 0 0; a direction is expected.")
        axes.append((axis, _three(row.get("offset"), 1.0 / MM_PER_M, f"offset of {name}")))
    return ObjectModel(
        obj_id=obj_id,
        name=text(info.get("name", file.stem), f"name of {where}"),
        mesh=mesh,
        symmetries=np.stack(symmetries),
        symmetry_axes=tuple(axes),
        density=number(info.get("density", 1000.0), f"density of {where}"),
    )


def _listed(info: Mapping[str, Any], key: str, where: str) -> Sequence[Any]:
    value = info.get(key, ())
    if not isinstance(value, (list, tuple)):
        raise InputError(f"{key} of {where} is {value!r:.60}; a list is expected.")
    return value  # pyright: ignore[reportUnknownVariableType]


def _three(value: Any, factor: float, name: str) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in numbers(value, 3, name))
    # One product for each: an offset that was written comes back to the last digit.
    return x * factor, y * factor, z * factor


def _check_diameter(mesh: Mesh, info: dict[str, Any], file: Path) -> None:
    extent_mm = mesh.extent * MM_PER_M
    low, high = extent_mm.max(), np.linalg.norm(extent_mm)
    given = number(info.get("diameter", low), f"diameter of {file.name} in {INFO_FILE}", 0.0)
    if high <= LARGEST_DIAMETER_M * MM_PER_M and high / UNIT_RATIO < given < low * UNIT_RATIO:
        return  # whatever it is between the box's side and its diagonal
    found_mm = diameter(mesh) * MM_PER_M
    if found_mm > LARGEST_DIAMETER_M * MM_PER_M:
        raise UnitError(
            f"{file} has a diameter of {found_mm:.4g} mm; BOP models are in millimetres and at "
            f"most {LARGEST_DIAMETER_M:g} m is accepted. Is it in micrometres?"
        )
    if "diameter" not in info:
        return
    said_mm = number(info["diameter"], f"diameter of {file.name} in {INFO_FILE}", 0.0)
    if not said_mm / UNIT_RATIO < found_mm < said_mm * UNIT_RATIO:
        raise UnitError(
            f"{file} has a diameter of {found_mm:.4g} mm, but {INFO_FILE} says {said_mm:.4g} mm: "
            "one of them is not in millimetres. Scale the file that is wrong by 1000."
        )
