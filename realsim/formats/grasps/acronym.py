"""Grasps of one object as an ACRONYM file, and ACRONYM files as grasps.

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
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.formats.grasps.hand_frames import grasp_poses, hand_poses, require_panda
from realsim.formats.grasps.hdf5 import get_set, put_set
from realsim.formats.grasps.scene_grasps import (
    check_values,
    executed,
    held,
    untried_set,
)
from realsim.formats.hdf5_checked import CheckedGroup, opened
from realsim.geometry import se3
from realsim.records import GraspSet
from realsim.robots.hand import find_hand
from realsim.store import atomic

FLEX = "grasps/qualities/flex"
OURS = "grasps/qualities/realsim"
MOTIONS = tuple(
    f"object_motion_during_{phase}_{kind}"
    for phase in ("closing", "shaking")
    for kind in ("linear", "angular")
)
"""Other qualities of FleX's: how far the object moved [m] or turned [rad]."""


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


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class AcronymGrasps:
    """What an ACRONYM file says."""

    obj: AcronymObject
    Ts_obj_grasp: Array
    """(N, 4, 4) [m], frame `grasp`."""
    object_in_gripper: Mask
    """(N,) whether the simulator of the file found the object held."""
    simulator: str
    """Whose label it is."""
    motions: dict[str, Array] = field(default_factory=dict[str, Array])
    """(N,) FleX's motions of the object [m or rad], by the names of MOTIONS."""
    tried: GraspSet | None = None
    """The set, score and all, where realsim wrote the file; without the rows that it left out."""

    def as_set(self, obj_id: int, instance: int = 0) -> GraspSet:
        """Return the grasps as a set that our physics has not tried; the label is not a score."""
        source = {"from": "ACRONYM", "file": self.obj.file, "simulator": self.simulator}
        return untried_set(
            self.Ts_obj_grasp, obj_id=obj_id, instance=instance, parameters={"source": source}
        )


# --- writing ----------------------------------------------------------------------------------


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


# --- reading ----------------------------------------------------------------------------------


def read_acronym(path: Path | str) -> AcronymGrasps:
    """Return the grasps of an ACRONYM file, ACRONYM's own or one of `write_acronym`.

    Raises:
        InputError: it is none, damaged, or points into other files; the grasps are not rigid, or
            not of the Panda's hand.
    """
    with opened(path) as file:
        gripper = file.group("gripper").text("type") if file.has("gripper") else "panda"
        if gripper != "panda":
            raise file.wrong(f"the gripper is '{gripper}'; grasps of the Panda's hand are read.")
        grasps = file.group("grasps")
        Ts_hand = grasps.numbers("transforms", (None, 4, 4))
        n = len(Ts_hand)
        qualities = grasps.group("qualities")
        flex = qualities.group("flex")
        label = flex.numbers("object_in_gripper", (n,))
        if not np.all((label == 0) | (label == 1)):
            raise flex.wrong("object_in_gripper holds other values than 0 and 1.")
        is_ours = qualities.has("realsim")
        Ts = se3.check_rigid(grasp_poses(Ts_hand, "acronym"), f"{path}: grasps") if n else Ts_hand
        tried = None
        if is_ours:
            tried = get_set(qualities.group("realsim"), Ts)
            check_values(tried)
        return AcronymGrasps(
            obj=_get_object(file.group("object")),
            Ts_obj_grasp=Ts,
            object_in_gripper=label == 1,
            simulator=flex.attribute("simulator", str) if is_ours else "FleX",
            motions={m: flex.numbers(m, (n,)) for m in MOTIONS if flex.has(m)},
            tried=tried,
        )


def _get_object(group: CheckedGroup) -> AcronymObject:
    def numbers(name: str, shape: tuple[int, ...]) -> Array | None:
        if not group.has(name):
            return None
        found = group.numbers(name, shape)
        if not np.all(np.isfinite(found)):
            raise group.wrong(f"'{name}' holds a number that is not finite.")
        return found

    def number(name: str) -> float | None:
        found = numbers(name, ())
        return None if found is None else float(found)

    scale = number("scale")
    if scale is None or scale <= 0:
        raise group.wrong(f"the scale is {scale}; a number above 0 is expected.")
    return AcronymObject(
        file=group.text("file"),
        scale=scale,
        density=number("density"),
        friction=number("friction"),
        mass_kg=number("mass"),
        volume_m3=number("volume"),
        center_of_mass=numbers("com", (3,)),
        inertia=numbers("inertia", (3, 3)),
    )
