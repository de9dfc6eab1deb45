"""What the Panda looks like: the meshes that PyBullet's package brings, drawn with few triangles.

Its frames are those of `arm.panda`: link i's mesh is in joint i's frame, the hand's in the frame of
its mounting face, and a finger's slides along y by half the opening.
"""

import warnings
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh_files import load_mesh
from realsim.models.simplify import colors_at, simplified
from realsim.records import Mesh
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim_sim_bridge.arm import panda

Array = NDArray[np.float64]
LINK_FACES = 1500
"""Triangles of a link: at 320 x 240 none is seen, and a frame is prepared in 30 instead of 600
ms."""
WHITE = 235
"""Grey level of parts that come without colours: the arm's white lacquer."""
FINGER_Z_M = 0.0584
"""Where the fingers' frame is along the hand's approach axis (panda.urdf) [m]."""
FINGER_TURNS = (0.0, np.pi)
"""Turn of each finger's frame about the hand's axis: that at +y, that at -y [rad]."""


def panda_meshes(joints_rad: Array, opening_m: float, T_table_base: Array) -> list[PlacedMesh]:
    """Return arm, hand and fingers where they are, table frame.

    Args:
        joints_rad: (7,) [rad].
        opening_m: distance of the finger faces [m].
        T_table_base: (4, 4) [m].

    Raises:
        InputError: PyBullet's package does not have the meshes.
    """
    looks = _looks()
    frames = T_table_base @ panda.link_frames(joints_rad)
    placed = [
        PlacedMesh(BACKGROUND, mesh, frames[i]) for i, mesh in enumerate(looks[: panda.JOINTS + 1])
    ]
    T_hand = frames[-1] @ se3.from_translation([0.0, 0.0, -panda.TCP_M])
    placed.append(PlacedMesh(BACKGROUND, looks[-2], T_hand))
    slide = se3.from_translation([0.0, opening_m / 2.0, 0.0])
    for turn in FINGER_TURNS:
        T_finger = se3.from_rt(se3.exp_so3([0.0, 0.0, turn]), [0.0, 0.0, FINGER_Z_M]) @ slide
        placed.append(PlacedMesh(BACKGROUND, looks[-1], T_hand @ T_finger))
    return placed


@lru_cache(maxsize=1)
def _looks() -> tuple[Mesh, ...]:
    """Return the meshes of links 0 to 7, the hand and a finger."""
    import pybullet_data

    folder = Path(pybullet_data.getDataPath()) / "franka_panda" / "meshes"
    # The package has no finer ones of the foot and of the flange.
    files = ["collision/link0.obj", *(f"visual/link{i}.obj" for i in range(1, 7)),
             "collision/link7.obj", "visual/hand.obj", "visual/finger.obj"]  # fmt: skip
    missing = [name for name in files if not (folder / name).is_file()]
    if missing:
        raise InputError(
            f"the Panda's mesh {folder / missing[0]} is missing, so that the arm cannot be drawn; "
            "it comes with the package pybullet. Install that again."
        )
    meshes: list[Mesh] = []
    for name in files:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # colours that two of the files name are not there
            mesh = simplified(load_mesh(folder / name, "m"), LINK_FACES)
        colors = mesh.colors
        if mesh.texture is not None:
            colors = colors_at(mesh, mesh.vertices)
        if colors is None:
            colors = np.full((len(mesh.vertices), 3), WHITE, np.uint8)
        meshes.append(Mesh(vertices=mesh.vertices, faces=mesh.faces, colors=colors))
    return tuple(meshes)
