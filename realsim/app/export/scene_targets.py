"""Registered scenes for simulators: bodies with mass, inertia and convex parts on a table.

Grasps of sessions in the formats of other programs, one folder a scene.
"""

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from realsim.app.console import Console
from realsim.app.export.target import METRES, TRIED, SceneJob, Target
from realsim.errors import InputError
from realsim.formats.export_folder import ExportFolder
from realsim.formats.grasps.scene_grasps import executed, labelled
from realsim.formats.labelled_scene import LabelledScene, WrittenScene
from realsim.formats.session_scene import SessionScene

if TYPE_CHECKING:
    from realsim.formats.robot_scenes.placed_scene import PlacedScene


LABELLED_ONLY = ("acronym", "graspgen", "isaac")
"""Formats of grasps that have a label by physics."""


def session_of(scene: LabelledScene) -> SessionScene:
    """Return the session that a scene is.

    Raises:
        InputError: it is a data set of others, which has no grasps tried by physics.
    """
    if not isinstance(scene, SessionScene):
        raise InputError(
            f"{scene.name} is no session, and grasps are tried in sessions: import it "
            "(`realsim import`), register it, and run `realsim school`."
        )
    return scene


def _files(scene: LabelledScene, folder: ExportFolder, job: SceneJob) -> WrittenScene:
    from realsim.app.school.files import export

    session, inner = session_of(scene), folder.below(job.place.name)
    request = job.request
    written = not inner.has("grasps")
    if written:
        with tempfile.TemporaryDirectory() as place:
            target = Path(place) / "grasps"
            export(session.store.folder, request.target, target, request.least_score)
            found = {p.relative_to(target).as_posix(): p for p in sorted(target.rglob("*"))}
            inner.write_piece("grasps", {name: p for name, p in found.items() if p.is_file()})
    job.tick()
    sets = () if (grasps := session.grasps()) is None else grasps.sets
    all_of_them, count, notes = sum(len(s) for s in sets), 0, list[str]()
    for s in sets:
        rows = np.ones(len(s), dtype=np.bool_)
        if request.target == "isaac":
            rows = labelled(s) & (s.labels >= request.least_score)
        elif request.target in LABELLED_ONLY:
            rows = executed(s)
        count += int(rows.sum())
    if request.target in LABELLED_ONLY and count < all_of_them:
        score = f", or whose label is below {request.least_score:g}," * (request.least_score > 0)
        notes.append(
            f"{all_of_them - count} of {all_of_them} grasps are left out: those that physics did "
            f"not try{score} are no grasps to this format."
        )
    return WrittenScene(
        name=session.name, folder=inner.place, frames=0, frames_written=0, objects=len(sets),
        notes=tuple(notes), counts={"grasps": count},
    )  # fmt: skip


def _grasp_groups(scene: LabelledScene, folder: ExportFolder, job: SceneJob) -> WrittenScene:
    """Write the grasps of every frame in its camera, as graspnetAPI's GraspGroup."""
    from realsim.app.school.files import no_grasps
    from realsim.formats.graspnet.grasp_group import grasp_group, grasp_group_files

    session, inner = session_of(scene), folder.below(job.place.name)
    grasps = session.grasps()
    if grasps is None:
        raise no_grasps(session.store.folder)
    written, count = 0, 0
    for index in session.indices:
        frame = session.frame(index)
        poses = {o.instance: o.T_cam_obj for o in frame.objects if o.instance is not None}
        sets = [s for s in grasps.sets if s.instance in poses]
        group = grasp_group(sets, poses)
        count += len(group)
        piece = f"{index:06d}"
        if not inner.has(piece):
            inner.write_piece(piece, grasp_group_files(f"{piece}.npy", group))
            written += 1
        job.tick()
    return WrittenScene(
        name=session.name, folder=inner.place, frames=len(session.indices),
        frames_written=written, objects=len(grasps.sets), counts={"grasps": count},
        notes=("single precision: poses agree to about 1e-6.",),
    )  # fmt: skip


def _target(name: str, what: str, conventions: tuple[tuple[str, str], ...], loading: str,
            options: tuple[str, ...] = ()) -> Target:  # fmt: skip
    return Target(
        name=name, kind="grasps", help=what, conventions=(METRES, *conventions), loading=loading,
        write_scene=_files, holds_grasps=True, options=options,
    )  # fmt: skip


GRASPS: dict[str, Target] = {
    "grasp-group": Target(
        name="GraspGroup (graspnetAPI)",
        kind="grasps",
        help="tried grasps of every frame in its camera, (N, 17) npy",
        conventions=(
            METRES,
            ("row", "score, width, height, depth, rotation (9, row-major), translation, object"),
            ("frame", "x = approach, y = closing, origin `depth` before the contacts"),
            ("poses", "in the frame's camera (OpenCV axes)"),
            ("score", "p_hold, of sets without it the slip test's score; 0 to 1, higher is better;"
             " not GraspNet's friction"),
            ("beside", "000000.labels.npz: score, stages, p_hold, error, safety; a row a grasp"),
            ("object", "GraspNet's number: realsim's id - 1"),
        ),
        loading='import numpy as np\ngrasps = np.load("{scene}/{file:*.npy}")',
        write_scene=_grasp_groups,
        holds_grasps=True,
        options=("labels",),
    ),
    "acronym": _target(
        "ACRONYM", "HDF5, one file an object",
        (("frame", "mounting face, 0.1034 m behind the contacts; z = approach, x = closing"),
         ("label", "1 = still held after all four stages; scores, p_hold, its error and safety "
          "under qualities/realsim")),
        'import h5py\nfile = h5py.File("{scene}/{file:*.h5}")',
    ),
    "graspgen": _target(
        "GraspGen", "JSON, one file an object",
        (("frame", "as ACRONYM's"),
         ("label", "1 = still held after all four stages; the rest under the key realsim")),
        'import json\ngrasps = json.load(open("{scene}/{file:*.json}"))["grasps"]',
    ),
    "isaac": _target(
        "isaac_grasp", "YAML, one file an object",
        (("frame", "panda_hand: mounting face; z = approach, y = closing"),
         ("confidence", "p_hold, of sets without it the score; a comment says which")),
        'import yaml\ngrasps = yaml.safe_load(open("{scene}/{file:*.yaml}"))["grasps"]',
        ("least_score",),
    ),
    "hdf5": _target(
        "realsim HDF5", "all of a scene in one file, exact",
        (("frame", "between the fingertips; z = approach, y = closing"),),
        'import h5py\nfile = h5py.File("{scene}/grasps.h5")',
    ),
    "parquet": _target(
        "realsim Parquet", "one row a grasp",
        (("frame", "between the fingertips; z = approach, y = closing"),),
        'import pyarrow.parquet as pq\ntable = pq.read_table("{scene}/grasps.parquet")',
    ),
}  # fmt: skip
"""By the name that the command line gives them."""


CAMERAS = 8
"""Views that go along as cameras, spread over the session."""
UP = ("axes", "z up, against gravity; world as in the session")
BODIES = ("bodies", "the model's own frame; mass, centre of mass and inertia given, convex parts")
WORLD_FRAME = ("poses", "object -> world")


def placed_scene(session: SessionScene) -> "PlacedScene":
    """Return a session's registered scene with what physics needs; the session is only read.

    Convex parts come from the model library or the School's cache where they are there; else they
    are made, which takes seconds an object.

    Raises:
        InputError: the session is not registered, or a mesh has no volume.
    """
    from realsim.app.school.inputs import CACHE, SchoolRequest, session_inputs
    from realsim.formats.robot_scenes.placed_scene import SceneCamera
    from realsim.formats.robot_scenes.placing import Matter, place_scene
    from realsim_sim_bridge.scenes.school_scene import Matter as Cut
    from realsim_sim_bridge.scenes.school_scene import known_solids

    store = session.store
    found = session_inputs(store, SchoolRequest(), Console(quiet=True))
    used = {o.obj_id: found.models[o.obj_id] for o in found.scene.objects}
    with tempfile.TemporaryDirectory() as place:
        cache = Path(place) / "cache"
        if (found.folder / CACHE).is_dir():
            shutil.copytree(found.folder / CACHE, cache)
        solids = known_solids(used, Cut(cache=cache), found.solids)
    matter = {
        i: Matter(
            mass_kg=s.matter.mass_kg, center_of_mass=s.matter.center_of_mass,
            inertia=s.matter.inertia, parts=s.parts.parts,
        )
        for i, s in solids.items()
    }  # fmt: skip
    posed = list(store.session.Ts_world_cam.items())
    camera = store.session.intrinsics
    cameras = [
        SceneCamera(name=f"view_{k:06d}", intrinsics=camera, T_world_cam=T)
        for k, T in posed[:: max(1, len(posed) // CAMERAS)][:CAMERAS]
    ]
    return place_scene(found.scene, found.models, matter, cameras=cameras)


def _urdf(scene: LabelledScene, folder: ExportFolder, job: SceneJob) -> WrittenScene:
    from realsim.formats.robot_scenes.urdf import write_urdf_scene

    return _engine_scene(scene, folder, job, write_urdf_scene)


def _mjcf(scene: LabelledScene, folder: ExportFolder, job: SceneJob) -> WrittenScene:
    from realsim.formats.robot_scenes.mjcf import write_mjcf_scene

    return _engine_scene(scene, folder, job, write_mjcf_scene)


def _usd(scene: LabelledScene, folder: ExportFolder, job: SceneJob) -> WrittenScene:
    from realsim.formats.robot_scenes.usd_scene import write_usd_scene

    return _engine_scene(scene, folder, job, write_usd_scene)


def _graspit(scene: LabelledScene, folder: ExportFolder, job: SceneJob) -> WrittenScene:
    from realsim.formats.graspit.writing import paired_grasps, write_graspit

    session = session_of(scene)
    grasps = session.grasps()
    sets = () if grasps is None else grasps.sets
    pairs = [paired_grasps(s) for s in sets]
    place = folder.below(job.place.name)
    written = write_graspit(placed_scene(session), pairs, place, progress=job.tick)
    tried = sum(len(s) for s in sets)
    bad = sum(int((~s.good).sum()) for s in sets)
    note = f"all {tried} grasps are there, the {bad} that failed among them: scores have no place."
    return replace(written, name=session.name, notes=(*written.notes, note))


def _engine_scene(
    scene: LabelledScene, folder: ExportFolder, job: SceneJob, write: Callable[..., WrittenScene]
) -> WrittenScene:
    """Write a session's scene for an engine, under its own name; note the views that stay out."""
    session = session_of(scene)
    written = write(placed_scene(session), folder.below(job.place.name), progress=job.tick)
    posed = len(session.store.session.Ts_world_cam)
    notes = list(written.notes)
    if posed > CAMERAS:
        notes.append(f"{CAMERAS} of {posed} views are there as cameras.")
    return replace(written, name=session.name, notes=tuple(notes))


SCENES: dict[str, Target] = {
    "urdf": Target(
        name="URDF",
        kind="scene",
        help="one URDF a body, scene.json with the poses, a script that loads them in PyBullet",
        conventions=(METRES, UP, BODIES, WORLD_FRAME, ("quaternions in scene.json", "x y z w")),
        loading='import json\nscene = json.load(open("{scene}/scene.json"))',
        write_scene=_urdf,
        no_place=(TRIED,),
    ),
    "mjcf": Target(
        name="MJCF (MuJoCo)",
        kind="scene",
        help="scene.xml with free bodies, meshes and textures",
        conventions=(METRES, UP, BODIES, WORLD_FRAME, ("quaternions", "w x y z")),
        loading='import mujoco\nmodel = mujoco.MjModel.from_xml_path("{scene}/scene.xml")',
        write_scene=_mjcf,
        no_place=(TRIED,),
    ),
    "usd": Target(
        name="USD (Isaac Sim)",
        kind="scene",
        help="UsdPhysics scene with rigid bodies, convex colliders and materials (extra `usd`)",
        conventions=(
            METRES, UP, BODIES,
            ("stage", "metersPerUnit 1, upAxis Z"),
            ("cameras", "OpenGL axes: x right, y up, z backward"),
        ),
        loading='from pxr import Usd\nstage = Usd.Stage.Open("{scene}/scene.usda")',
        write_scene=_usd,
        no_place=(TRIED,),
    ),
    "graspit": Target(
        name="GraspIT (the paper's authors)",
        kind="scene",
        help="scene.yaml, grasps.hdf5 and meshes as the paper's authors have them",
        conventions=(METRES, ("axes", "z up out of the table"), ("quaternions", "w x y z")),
        loading='import yaml\nscene = yaml.safe_load(open("{scene}/scene.yaml"))',
        write_scene=_graspit,
        holds_grasps=True,
    ),
}  # fmt: skip
"""By the name that the command line gives them."""
