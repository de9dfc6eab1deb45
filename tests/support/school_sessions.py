"""A registered session of two things, and the command `realsim school` in this process."""

from pathlib import Path

import numpy as np
from click.testing import Result

import typed_commands
from begun_sessions import begun
from realsim.formats.bop.models import save_models
from realsim.geometry import se3
from realsim.geometry.parts import part
from realsim.records import ObjectPose, Scene, SupportPlane
from realsim.store import save_scene
from registered_sessions import CAMERA

GRASPS = 5
QUICK = ("--engine", "mujoco", "--grasps", GRASPS, "--workers", "1", "--quiet")
WEAK = ("--engine", "mujoco", "--grasps", "8", "--workers", "1", "--quiet", "--force", "4",
        "--friction", "0.3")  # fmt: skip
"""So weak that some grasps hold and some slip."""
NAMES = ("cube", "wedge")
T_WORLD_TABLE = se3.from_rt(se3.exp_so3(np.array([0.0, 0.0, 0.4])), [0.3, 0.1, 0.02])


def run(*args: object) -> Result:
    """Run the group in this process."""
    return typed_commands.invoked("school", *args)


def finished(*args: object) -> Result:
    """Run the group, which has to end with 0."""
    return typed_commands.finished("school", *args)


def refused(*args: object) -> str:
    """Return what the group refuses the arguments with."""
    return typed_commands.refused("school", *args)


def scene() -> Scene:
    """Two convex things, apart on a table that is not the world's xy plane."""
    objects = tuple(
        ObjectPose(obj_id=part(name).obj_id, instance=k, T_world_obj=standing(name, x, angle))
        for k, (name, x, angle) in enumerate(zip(NAMES, (-0.1, 0.1), (0.2, 1.1), strict=True))
    )
    return Scene(name="two", objects=objects, plane=SupportPlane(T_world_table=T_WORLD_TABLE))


def standing(name: str, x: float, angle: float) -> np.ndarray:
    """Return T_world_obj of a part that stands on its lowest point."""
    T = se3.from_rt(se3.exp_so3(np.array([0.0, 0.0, angle])), [x, 0.0, 0.0])
    T[2, 3] = -part(name).mesh.bounds[0][2]
    return T_WORLD_TABLE @ T


def registered(folder: Path) -> Path:
    """Write a registered session of the scene and return its folder."""
    store = begun(folder, CAMERA)
    save_models(folder / "models", {part(n).obj_id: part(n) for n in NAMES})
    save_scene(store, scene())
    return folder


def tried_weakly(folder: Path) -> Path:
    """Write a registered session whose grasps a weak hand tried: some hold, some slip."""
    registered(folder)
    typed_commands.finished("school", folder, *WEAK, "--grasps", 14)
    return folder
