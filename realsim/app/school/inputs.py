"""What a school tries: a scene from a session or from another program's files, and its matter."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from realsim.app.console import Console
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.many import Workers
from realsim.models.model_records import KnownSolid
from realsim.records import ObjectModel, Scene, names_of
from realsim.robots.robot_files import STIFFEST_N_PER_M
from realsim.store import SessionStore, atomic
from realsim.store.opening import require_header

CACHE = "grasps/cache"
"""Where in the results' folder pieces of work and convex parts are kept."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SchoolRequest:
    """What the user asked for; None = the school's own value."""

    grasps: int = 60
    """Candidates kept per object, at most."""
    seed: int = 0
    arm: str = "panda"
    """Name or folder of the arm."""
    hand: str = "franka_hand"
    """Its name or its folder."""
    engine: str = "pybullet"
    """'pybullet' or 'mujoco'."""
    cross_check: bool = False
    """Whether the other engine tries the same grasps."""
    sweep: bool = False
    """Whether margins are measured."""
    force_n: float | None = None
    """Force of each finger [N]."""
    friction: float | None = None
    stiffness_n_per_m: float | None = None
    """Normal stiffness of one pad [N/m]."""
    draws: int = 16
    """Draws behind p_hold, 2 or more."""
    cell_error: tuple[float, float, float, float] | None = None
    """Standard deviations where grasps are executed: across [mm], height [mm], yaw, tilt [deg]."""
    calibration: Path | None = None
    """File of p_hold's calibration, as `realsim school reality --fit` writes it."""
    density: float | None = None
    """Density of all objects that are not weighed [kg/m^3]."""
    masses: tuple[str, ...] = ()
    """Weighed objects, each NAME=KG or ID=KG."""
    base_pose: Path | None = None
    """File with the pose of the robot's base."""
    points: int | None = None
    """Points on the surface that candidates start from."""
    rotations: int | None = None
    """Grasps per pair of contacts."""
    where: Workers = 2
    restart: bool | Literal["finished"] = False
    """Whether results of other parameters are thrown away; "finished" = those of a finished run."""
    models: Path | None = None
    """Folder of the models, where a scene's source has them elsewhere."""
    supports: tuple[Path, ...] = ()
    """URDF files of what stands still besides the table, each in the table's frame."""
    quaternions: Literal["wxyz", "xyzw"] | None = None
    """Their order in a scene.yaml, where its content does not tell it."""

    def __post_init__(self) -> None:
        """Check the numbers: physics with them would mean nothing.

        Raises:
            InputError: one that cannot be; its option is named.
        """
        _require_positive("--force", self.force_n, "N; 70 is the Franka Hand's", most=1000.0)
        _require_positive("--friction", self.friction, "; dry rubber on wood has 1", most=10.0)
        _require_positive(
            "--stiffness", self.stiffness_n_per_m,
            "N/m of a whole pad; the Franka Hand's is taken as 200000",
            least=1e3, most=STIFFEST_N_PER_M,
        )  # fmt: skip
        _require_positive(
            "--density", self.density, "kg/m^3; plastics have 1000", most=25000.0, least=1.0
        )


def _require_positive(
    option: str, value: float | None, words: str, *, most: float, least: float = 0.0
) -> None:
    """Raise if a number is given that is not positive and finite, or out of all proportion."""
    if value is None or (math.isfinite(value) and least <= value <= most and value > 0):
        return
    raise InputError(
        f"{option} {value:g} cannot be: a number above {least:g} and up to {most:g} is accepted "
        f"({words.lstrip('; ')})."
    )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SchoolInputs:
    """A scene that the school can try."""

    scene: Scene
    models: dict[int, ObjectModel]
    solids: dict[int, KnownSolid]
    """Convex parts and matter by object id, as far as they are known; the school makes the rest."""
    folder: Path
    """Where results go: the session, or a folder of the user's."""
    store: SessionStore | None
    """The session; None = the scene came from elsewhere."""

    def write(self, name: str, data: bytes) -> None:
        """Write a file of the results, in a session with its checksum."""
        if self.store is not None:
            self.store.write_bytes(name, data)
        else:
            atomic.write_bytes(self.folder / name, data)


def is_session(source: Path) -> bool:
    """Return whether the source is a session of realsim.

    Raises:
        InputError: it is one whose header is lost.
    """
    require_header(source)
    return (source / "session.json").is_file()


def read_inputs(
    source: Path, out: Path | None, request: SchoolRequest, console: Console
) -> SchoolInputs:
    """Return what is to be tried.

    Args:
        source: a session, or a BOP scene, GraspNet scene or scene.yaml.
        out: folder for the results of a source that is no session.
        request: masses, density, and where models are.
        console: notes go there.

    Raises:
        InputError: nothing usable there, a folder missing or not wanted, or an unknown object.
    """
    from realsim.app.stages import hint_of, open_session

    if is_session(source):
        if out is not None:
            raise InputError(
                f"'{source}' is a session, which keeps its own results; leave --out away, or use "
                "`realsim school export` to write them elsewhere."
            )
        return session_inputs(open_session(source), request, console)
    if not source.exists():
        raise InputError(
            f"'{source}' does not exist; a session, a BOP scene, a GraspNet scene or a scene.yaml "
            "is expected."
        )
    if out is None and source.is_file():
        raise InputError(
            f"'{source}' is no session, so its results need a folder: add --out FOLDER."
        )
    if out is None:
        raise InputError(
            f"'{source}' holds no session.json, so it is not a session.{hint_of(source)} Give a "
            "session, or a BOP scene, a GraspNet scene or a scene.yaml with --out FOLDER for its "
            "results."
        )
    if out.exists() and not out.is_dir():
        raise InputError(f"--out '{out}' is a file; a folder for the results is expected.")
    if is_session(out):
        raise InputError(f"--out '{out}' is a session; give a folder of its own.")
    return weighed(_of_source(source, out, request, console), request)


def session_inputs(store: SessionStore, request: SchoolRequest, console: Console) -> SchoolInputs:
    """Return the registered scene of a session, as the reviewers left it.

    Raises:
        InputError: the session is not registered, or a mass is of no object.
    """
    from realsim.app.stages import judged_scene, session_models
    from realsim.models.library_session import known_solids

    scene, models = judged_scene(store), session_models(store)
    solids, unknown = known_solids(store.folder / "models", [o.obj_id for o in scene.objects])
    for obj_id, why in unknown.items():
        console.warn(f"object {obj_id}: its convex parts are made again: {why}.")
    found = SchoolInputs(
        scene=scene, models=models, solids=dict(solids), folder=store.folder, store=store
    )
    return weighed(found, request)


def _of_source(source: Path, out: Path, request: SchoolRequest, console: Console) -> SchoolInputs:
    """Return the scene of another program's files."""
    from realsim_sim_bridge.scenes.importers import load_scene_source
    from realsim_sim_bridge.scenes.school_scene import Matter

    if request.models is not None and not request.models.is_dir():
        raise InputError(f"--models '{request.models}' is no folder.")
    found = load_scene_source(
        source, Matter(cache=out / CACHE), models=request.models, order=request.quaternions
    )
    console.warn(*found.notes)
    return SchoolInputs(
        scene=found.scene, models=found.models, solids=dict(found.solids), folder=out, store=None
    )


# --- matter -----------------------------------------------------------------------------------


def weighed(found: SchoolInputs, request: SchoolRequest) -> SchoolInputs:
    """Return the inputs with the masses and the density that the user knows better.

    Raises:
        InputError: a mass is of no object, or cannot be.
    """
    used = {o.obj_id for o in found.scene.objects}
    models = {i: m for i, m in found.models.items() if i in used}
    masses = masses_of(request.masses, models)
    if not masses and request.density is None:
        return found
    from realsim_sim_bridge.scenes.school_scene import Matter, known_solids

    solids, changed = dict(found.solids), dict(found.models)
    if request.density is not None:
        changed |= {i: replace(m, density=request.density) for i, m in models.items()}
    matter = Matter(cache=found.folder / CACHE)
    for obj_id in models:
        if obj_id in masses:
            mine = replace(matter, masses_kg={obj_id: masses[obj_id]})
            have = {obj_id: solids[obj_id]} if obj_id in solids else {}
            solids |= known_solids({obj_id: changed[obj_id]}, mine, have)
        elif request.density is not None and obj_id in solids:
            solids[obj_id] = _of_density(changed[obj_id], solids[obj_id], request.density)
    return replace(found, models=changed, solids=solids)


def _of_density(model: ObjectModel, solid: KnownSolid, density: float) -> KnownSolid:
    """Return the same parts with the matter of another density."""
    from realsim.models.properties import physical_properties

    matter = physical_properties(model.mesh, density=density, parts=solid.parts)
    return replace(solid, matter=matter)


def named_mass(text: str) -> tuple[str, float]:
    """Return name and mass [kg] of a text NAME=KG.

    Raises:
        InputError: it is of no such form, or no positive mass.
    """
    name, mark, number = text.rpartition("=")
    try:
        mass = float(number)
    except ValueError:
        mass = math.nan
    if not mark or not name or not (math.isfinite(mass) and 0 < mass <= 100):
        raise InputError(
            f"--weighed '{text}' is no weighed object; NAME=KG with a mass above 0 and up to 100 "
            "kg is one, such as mug=0.31."
        )
    return name, mass


def spread_of(cell_error: tuple[float, float, float, float] | None) -> dict[str, Any]:
    """Return what `HoldConfig` takes of a stated cell error; nothing where none is stated.

    Raises:
        InputError: an error that no cell has.
    """
    from realsim_sim_bridge.hold.draws import PoseSpread

    if cell_error is None:
        return {}
    for name, value in zip(("across", "height", "yaw", "tilt"), cell_error, strict=True):
        if not 0 <= value <= 180:  # NaN, too
            raise InputError(
                f"--cell-error has {value:g} for {name}; 0 to 180 is accepted: standard deviations "
                "across [mm], in height [mm], of yaw and of tilt [deg], such as 8 3 10 3."
            )
    across_mm, height_mm, yaw_deg, tilt_deg = cell_error
    return {
        "spread": PoseSpread(
            across_m=1e-3 * across_mm, height_m=1e-3 * height_mm, yaw_deg=yaw_deg, tilt_deg=tilt_deg
        )
    }


def masses_of(texts: Sequence[str], models: Mapping[int, ObjectModel]) -> dict[int, float]:
    """Return weighed masses [kg] by object id.

    Args:
        texts: NAME=KG or ID=KG each.
        models: the objects of the scene.

    Raises:
        InputError: no such form, no such object, one named twice, or no positive mass.
    """
    masses: dict[int, float] = {}
    for text in texts:
        name, mass = named_mass(text)
        named = [i for i, m in models.items() if m.name == name or str(i) == name]
        if len(named) != 1:
            what = "names several objects" if named else "is of no object of this scene"
            raise InputError(
                f"--weighed '{text}' {what}; there are: {names_of(list(models.values()))}."
            )
        if named[0] in masses:
            raise InputError(f"--weighed names the object '{name}' twice; give it once.")
        masses[named[0]] = mass
    return masses


# --- where the robot stands -------------------------------------------------------------------

BASE_KEYS = ("T_world_base", "T_table_base")


def base_on_table(path: Path, scene: Scene) -> Array:
    """Return T_table_base (4, 4) [m] from a JSON file with T_world_base or T_table_base.

    Raises:
        InputError: no such file, not JSON, neither or both keys, no rigid transform, or no table.
    """
    from realsim.geometry import se3

    if not path.is_file():
        raise InputError(
            f"the base pose '{path}' is no file; a JSON file with one of "
            f"{' or '.join(BASE_KEYS)} (4 x 4, metres) is expected, or leave --base-pose away."
        )
    try:
        value: Any = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"the base pose '{path}' is no JSON ({error}).") from error
    keys = [k for k in BASE_KEYS if isinstance(value, dict) and k in value]
    if len(keys) != 1:
        raise InputError(
            f"the base pose '{path}' holds {' and '.join(keys) or 'no pose'}; exactly one of "
            f"{' or '.join(BASE_KEYS)} (4 x 4, metres) is accepted."
        )
    try:
        T = np.array(value[keys[0]], dtype=np.float64).reshape(4, 4)
    except (ValueError, TypeError) as error:
        raise InputError(f"{keys[0]} of '{path}' is no 4 x 4 matrix ({error}).") from error
    T = se3.check_rigid(T[None], f"{keys[0]} of '{path}'")[0]
    if keys[0] == "T_table_base":
        return T
    if scene.plane is None:
        raise InputError(f"scene '{scene.name}' has no table, so T_world_base says nothing of it.")
    return se3.invert(scene.plane.T_world_table) @ T
