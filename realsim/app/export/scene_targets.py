"""Registered scenes for simulators: bodies with mass, inertia and convex parts on a table."""

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from realsim.app.console import Console
from realsim.app.export.grasp_targets import session_of
from realsim.app.export.target import METRES, TRIED, SceneJob, Target
from realsim.formats.export_folder import ExportFolder
from realsim.formats.labelled_scene import LabelledScene, WrittenScene
from realsim.formats.session_scene import SessionScene

if TYPE_CHECKING:
    from realsim.formats.robot_scenes.placed_scene import PlacedScene

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
