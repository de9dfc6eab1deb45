"""Grasps of the school in other programs' formats, and figures over many schools."""

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.console import Console
from realsim.app.school.files import MODELS, stored_grasps
from realsim.app.school.tables import SUMMARY_HEADER, agreement_line, p_hold_line, setting_lines
from realsim.errors import InputError
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.records import GraspSet
from realsim.store.results import grasp_stem

if TYPE_CHECKING:
    from realsim.formats.grasps.acronym import AcronymObject

M_PER_MM = 1e-3
"""Scale of the exported meshes, which are in millimetres as BOP has them."""


def export(source: Path, target: str, out: Path, least_score: float = 0.0) -> list[Path]:
    """Write the grasps of a session or of a folder of results, and return the files.

    ACRONYM, GraspGen and isaac_grasp files hold one object each and are named after its instance;
    the meshes they speak of are copied beside them. HDF5 and Parquet hold the scene.

    Args:
        source: the session, or the folder of results.
        target: 'acronym', 'graspgen', 'isaac', 'hdf5' or 'parquet'.
        out: folder to write into; made if it is not there.
        least_score: of the grasps that an isaac_grasp file takes.

    Raises:
        InputError: no results there, an unknown format, the source's own folder or one that is not
            empty as `out`, or a least score for a format that keeps all.
    """
    if not 0.0 <= least_score <= 1.0:
        raise InputError(f"--least-score {least_score} cannot be: 0 to 1 is accepted.")
    if least_score > 0.0 and target != "isaac":
        raise InputError(
            f"--least-score is of isaac files, which hold grasps to use; a file of {target} keeps "
            "every grasp with its label. Leave it away."
        )
    if out.resolve() in (source.resolve(), (source / "grasps").resolve()):
        raise InputError(f"--out '{out}' holds the results themselves; give another folder.")
    if out.is_dir() and any(out.iterdir()):
        raise InputError(
            f"--out '{out}' is not empty; files of two exports would lie side by side. Give a new "
            "folder."
        )
    grasps = stored_grasps(source)[0]
    out.mkdir(parents=True, exist_ok=True)
    if target == "hdf5":
        from realsim.formats.grasps.hdf5 import write_grasps_hdf5

        return [write_grasps_hdf5(out / "grasps.h5", grasps)]
    if target == "parquet":
        from realsim.formats.grasps.parquet import write_grasps_parquet

        return [write_grasps_parquet(out, grasps)]
    return list(_one_by_one(source, grasps, target, out, least_score))


def _one_by_one(
    source: Path, grasps: SceneGrasps, target: str, out: Path, least_score: float
) -> Iterator[Path]:
    """Write one file an object."""
    from realsim.formats.grasps.acronym import write_acronym
    from realsim.formats.grasps.graspgen import write_graspgen
    from realsim.formats.grasps.isaac_grasp import write_isaac_grasp

    for s in grasps.sets:
        stem = grasp_stem(s)
        if target == "isaac":
            frame = grasps.names.get(s.obj_id) or f"object_{s.obj_id}"
            path = out / f"{stem}.yaml"
            yield write_isaac_grasp(path, s, object_frame=frame, least_score=least_score)
            continue
        mesh = _copied_mesh(source, s.obj_id, out)
        if target == "acronym":
            yield write_acronym(out / f"{stem}.h5", s, acronym_object(s, mesh))
        elif target == "graspgen":
            yield write_graspgen(out / f"{stem}.json", s, file=mesh, scale=M_PER_MM)
        else:
            raise InputError(f"there is no format '{target}' of grasps.")


def _copied_mesh(source: Path, obj_id: int, out: Path) -> str:
    """Copy an object's mesh beside the grasps and return its name there."""
    from realsim.formats.bop.models import model_file

    name = model_file(obj_id)
    (out / MODELS).mkdir(exist_ok=True)
    for file in (source / MODELS).glob(f"{Path(name).stem}.*"):
        if file.suffix in (".ply", ".png"):
            shutil.copyfile(file, out / MODELS / file.name)
    return f"{MODELS}/{name}"


def acronym_object(s: GraspSet, mesh: str) -> "AcronymObject":
    """Return what an ACRONYM file says of the object, as far as the set's parameters know it."""
    from realsim.formats.grasps.acronym import AcronymObject

    known = s.parameters
    physics: dict[str, Any] = ((known.get("config") or {}).get("slip") or {}).get("physics") or {}
    center = known.get("center_of_mass_m")
    mass, density = known.get("mass_kg"), known.get("density")
    return AcronymObject(
        file=mesh,
        scale=M_PER_MM,
        density=density,
        friction=physics.get("friction"),
        mass_kg=mass,
        volume_m3=mass / density if mass and density else None,
        center_of_mass=None if center is None else np.asarray(center, dtype=np.float64),
    )


def summarise(sources: Sequence[Path], json_file: Path | None, console: Console) -> None:
    """Show the paper's statistics over many sessions or folders of results.

    Raises:
        InputError: one of them has no results, or is given twice.
    """
    from realsim_sim_bridge.school.summary import summarise as summary_of

    scenes: dict[str, Sequence[GraspSet]] = {}
    for source in sources:
        key = str(source.resolve())
        if key in scenes:
            raise InputError(f"'{source}' is given twice; its grasps would count twice.")
        scenes[key] = stored_grasps(source)[0].sets
    summary = summary_of(scenes)
    number = "one scene" if len(scenes) == 1 else f"{len(scenes)} scenes"
    console.table(f"Robot School of {number}", SUMMARY_HEADER, summary.to_rows())
    sets = [s for part in scenes.values() for s in part]
    settings = setting_lines(sets)
    if len(settings) > 1:
        console.warn(
            "these scenes were tried at different settings; their scores are no one thing:"
        )
    console.say(*filter(None, (*settings, agreement_line(sets), p_hold_line(sets))))
    console.result(summary.to_json(), json_file)
