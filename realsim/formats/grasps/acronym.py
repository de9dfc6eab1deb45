"""Grasps of one object as an ACRONYM file.

    object/{file, scale, density, friction, mass, volume, com, inertia}
    gripper/{type, configuration}
    grasps/transforms                       (N, 4, 4) hand in object [m]; frame `acronym`
    grasps/qualities/flex/object_in_gripper (N,) 0 or 1
    grasps/qualities/realsim/               what our own physics said (written by realsim only)

ACRONYM's readers look for the label under `flex`, the name of its simulator, and nowhere else. So
the label is written there, with the attribute `simulator` that says it is not FleX's: 1 = the
fingers still held the object after all four stages. Everything that has no counterpart (score,
slips, reasons, measures) goes to `qualities/realsim`; ACRONYM's motions while closing and shaking
are left out, because our stages are other motions. Grasps that physics has not tried have no label,
so they are not written; their number is an attribute.

Source: NVlabs/acronym, acronym_tools/acronym.py and the example files.
"""

import io
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.formats.grasps.hand_frames import hand_poses, require_panda
from realsim.formats.grasps.hdf5 import put_set
from realsim.formats.grasps.scene_grasps import check_values, executed, held
from realsim.records import GraspSet
from realsim.robots.hand import find_hand
from realsim.store import atomic

FLEX = "grasps/qualities/flex"
OURS = "grasps/qualities/realsim"


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class AcronymObject:
    """The object of an ACRONYM file; None = the file does not say."""

    file: str
    """File of the mesh, relative to the data set's folder."""
    scale: float = 1.0
    """What the mesh is multiplied by to be in metres; the grasps belong to the scaled mesh."""
    density: float | None = None
    """[kg/m^3]."""
    friction: float | None = None
    mass_kg: float | None = None
    volume_m3: float | None = None
    center_of_mass: Array | None = None
    """(3,) [m]."""
    inertia: Array | None = None
    """(3, 3) [kg m^2]."""


def write_acronym(path: Path | str, grasps: GraspSet, obj: AcronymObject) -> Path:
    """Write the tried grasps of one object, whole or not at all.

    Raises:
        InputError: the set holds what no grasp has, or is of another hand than the Panda's.
    """
    path = Path(path)
    atomic.write_bytes(path, acronym_bytes(grasps, obj))
    return path


def acronym_bytes(grasps: GraspSet, obj: AcronymObject) -> bytes:
    """Return the tried grasps of one object as the content of an ACRONYM file."""
    import h5py

    check_values(grasps)
    require_panda(grasps, "an ACRONYM file")
    rows = np.flatnonzero(executed(grasps))
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        _put_object(file.create_group("object"), obj)
        gripper = file.create_group("gripper")
        gripper["type"] = "panda"
        gripper["configuration"] = np.array([find_hand().max_opening_m / 2.0])
        file["grasps/transforms"] = hand_poses(grasps.Ts_obj_grasp[rows], "acronym")
        flex = file.create_group(FLEX)
        flex["object_in_gripper"] = held(grasps)[rows].astype(np.int64)
        flex.attrs["simulator"] = f"realsim {version('realsim')}, not FleX; see {OURS}"
        ours = file.create_group(OURS)
        ours.attrs["left_out"] = len(grasps) - len(rows)
        ours.attrs["left_out_meaning"] = "grasps of the set that physics has not tried"
        ours["row"] = rows.astype(np.int64)
        put_set(ours, grasps, rows)
    return buffer.getvalue()


def _put_object(group: Any, obj: AcronymObject) -> None:
    """Write what is known of the object."""
    group["file"] = obj.file
    known = {
        "scale": obj.scale, "density": obj.density, "friction": obj.friction, "mass": obj.mass_kg,
        "volume": obj.volume_m3, "com": obj.center_of_mass, "inertia": obj.inertia,
    }  # fmt: skip
    for name, value in known.items():
        if value is not None:
            group[name] = np.asarray(value, dtype=np.float64)
