"""What a school leaves behind, and how it is read back.

grasps/000002_obj000007.npz .json   every set, exact and readable
grasps/trajectories/                what the arm did
grasps/grasps.h5                    everything in one file
models/                             the meshes, where the scene came from another program
reports/school.html school.json     the page, and its counts for programs

Grasps of the school in other programs' formats, and figures over many schools.
"""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.console import Console
from realsim.app.school.inputs import SchoolInputs, is_session
from realsim.app.school.tables import SUMMARY_HEADER, agreement_line, p_hold_line, setting_lines
from realsim.errors import InputError
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.records import GraspSet, ObjectModel, Scene
from realsim.records.grasps import GraspTrajectories
from realsim.store import atomic
from realsim.store.results import grasp_stem

if TYPE_CHECKING:
    from realsim.formats.grasps.acronym import AcronymObject


GRASPS, MODELS = "grasps", "models"
HDF5 = "grasps/grasps.h5"
PAGE, COUNTS = "reports/school.html", "reports/school.json"


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SchoolOutcome:
    """What a run found."""

    inputs: SchoolInputs
    sets: list[GraspSet]
    trajectories: Mapping[int, GraspTrajectories] = field(
        default_factory=dict[int, GraspTrajectories]
    )
    """What the arm did, by instance."""
    unfinished: Mapping[int, tuple[str, ...]] = field(default_factory=dict[int, tuple[str, ...]])
    """Work that was given up because it ended its worker again and again, by instance."""

    @property
    def models(self) -> dict[int, ObjectModel]:
        """The objects by id."""
        return self.inputs.models


def write_outcome(outcome: SchoolOutcome) -> None:
    """Write sets, tables, page and pictures; sets of objects that are gone are taken away."""
    from realsim.app.school.page import MARGINS, SHEET, margins_png, page_bytes, sheet_png
    from realsim.app.school.tables import as_json
    from realsim.formats.bop.models import save_models
    from realsim.store import save_grasps
    from realsim.store.trajectories import save_trajectories

    inputs, sets = outcome.inputs, outcome.sets
    place = inputs.store or inputs.folder / GRASPS
    stems = {save_grasps(place, s).stem for s in sets}
    _remove_others(inputs, stems)
    for s in sets:
        if s.instance in outcome.trajectories:
            save_trajectories(place, s, outcome.trajectories[s.instance])
    write_tables(inputs.folder, scene_grasps(outcome))
    if inputs.store is None:
        used = {o.obj_id for o in inputs.scene.objects}
        save_models(inputs.folder / MODELS, {i: inputs.models[i] for i in sorted(used)})
    pictures = {
        SHEET: sheet_png(sets, inputs.models, inputs.scene),
        MARGINS: margins_png(sets, inputs.models),
    }
    files = {f"reports/{name}": data for name, data in pictures.items() if data}
    files[PAGE] = page_bytes(inputs.scene.name, sets, inputs.models, pictures)
    files[COUNTS] = atomic.json_bytes(as_json(sets, inputs.models))
    for name, data in files.items():
        inputs.write(name, data)


def _remove_others(inputs: SchoolInputs, stems: set[str]) -> None:
    """Remove what an earlier run left of objects that have been rejected since, and its tables."""
    for part in (GRASPS, f"{GRASPS}/trajectories"):
        for file in sorted((inputs.folder / part).glob("*.*")):
            if not file.is_file() or (part == GRASPS and file.stem in stems):
                continue
            if inputs.store is not None:
                inputs.store.remove(f"{part}/{file.name}")
            else:
                file.unlink()


def scene_grasps(outcome: SchoolOutcome) -> SceneGrasps:
    """Return the outcome as the files of grasps hold it."""
    names = {i: m.name for i, m in outcome.models.items()}
    return _together(outcome.inputs.scene, outcome.sets, names, outcome.trajectories)


def _together(
    scene: Scene,
    sets: list[GraspSet],
    names: Mapping[int, str],
    trajectories: Mapping[int, GraspTrajectories],
) -> SceneGrasps:
    """Return the sets of a scene with their poses."""
    instances = {s.instance for s in sets}
    return SceneGrasps(
        sets=tuple(sets),
        name=scene.name,
        names={s.obj_id: names[s.obj_id] for s in sets if s.obj_id in names},
        trajectories=trajectories,
        Ts_world_obj={o.instance: o.T_world_obj for o in scene.objects if o.instance in instances},
        T_world_table=None if scene.plane is None else scene.plane.T_world_table,
    )


def write_tables(folder: Path, grasps: SceneGrasps) -> None:
    """Write grasps.h5, which other programs read."""
    from realsim.formats.grasps.hdf5 import write_grasps_hdf5

    write_grasps_hdf5(folder / HDF5, grasps)


# --- reading it back ----------------------------------------------------------------------------


def stored_grasps(folder: Path) -> tuple[SceneGrasps, dict[int, ObjectModel]]:
    """Return the grasps and models that a run left in a session or in a folder of results.

    Raises:
        InputError: no results there.
    """
    from realsim.formats.bop.models import load_models
    from realsim.formats.grasps.hdf5 import read_grasps_hdf5

    if is_session(folder):
        return _of_session(folder)
    if not (folder / HDF5).is_file():
        raise InputError(
            f"'{folder}' holds no results of Robot School: neither session.json nor {HDF5} is "
            f"there. Run `realsim school SESSION`, or `realsim school SCENE --out {folder}`, first."
        )
    return read_grasps_hdf5(folder / HDF5), load_models(folder / MODELS)


def _of_session(folder: Path) -> tuple[SceneGrasps, dict[int, ObjectModel]]:
    """Return the grasps of a session, from the sets themselves."""
    from realsim.app.stages import judged_scene, open_session, session_models
    from realsim.store import load_grasps
    from realsim.store.results import grasps_on
    from realsim.store.trajectories import load_trajectories

    store = open_session(folder)
    scene = judged_scene(store)
    sets = grasps_on(scene, load_grasps(store))
    if not sets:
        raise no_grasps(folder)
    models = session_models(store)
    attempts = {s.instance: load_trajectories(store, s) for s in sets}
    known = {i: a for i, a in attempts.items() if a is not None}
    names = {i: m.name for i, m in models.items()}
    return _together(scene, sets, names, known), models


def no_grasps(session: Path) -> InputError:
    """Return the error for a session without grasps of the objects that stand there."""
    return InputError(
        f"session '{session}' has no grasps of its objects: run `realsim school {session}`, with "
        "--restart if its grasps are of objects that are others now."
    )


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
