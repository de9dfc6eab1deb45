"""What a school leaves behind, and how it is read back.

grasps/000002_obj000007.npz .json   every set, exact and readable
grasps/trajectories/                what the arm did
grasps/grasps.h5                    everything in one file
models/                             the meshes, where the scene came from another program
reports/school.html school.json     the page, and its counts for programs
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from realsim.app.school.inputs import SchoolInputs, is_session
from realsim.errors import InputError
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.records import GraspSet, ObjectModel, Scene
from realsim.records.trajectories import GraspTrajectories
from realsim.store import atomic

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
    from realsim.store.trajectories import load_trajectories

    store = open_session(folder)
    sets = load_grasps(store)
    if not sets:
        raise InputError(f"session '{folder}' has no grasps yet: run `realsim school {folder}`.")
    models = session_models(store)
    attempts = {s.instance: load_trajectories(store, s) for s in sets}
    known = {i: a for i, a in attempts.items() if a is not None}
    names = {i: m.name for i, m in models.items()}
    return _together(judged_scene(store), sets, names, known), models
