"""Pictures of a step: table, objects and arm, rendered by the embedded renderer when asked for."""

import warnings
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.mesh_files import load_mesh
from realsim.models.simplify import colors_at, simplified
from realsim.records import Mesh
from realsim.rendering.photo import Lighting, PhotoRenderer
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim_sim_bridge.arm import panda
from realsim_sim_bridge.demonstrations.records import DemonstrationCamera, Rgb

# --- What the Panda looks like: the meshes that PyBullet's package brings, drawn with few triangles
# Its frames are those of `arm.panda`: link i's mesh is in joint i's frame, the hand's in the frame
# of its mounting face, and a finger's slides along y by half the opening.


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


TABLE_M, TABLE_THICKNESS_M = 1.8, 0.03
"""Edge and thickness of the drawn table [m]: a robot's table."""
MOST_FACES, FEWER_FACES = 20_000, 10_000
"""Meshes with more triangles than the first are drawn with the second: every frame prepares all."""
TEXTURE_PX = 512
"""Largest edge of a texture that is drawn: a model of 4096 px costs a second a frame."""
LIGHTING = Lighting(gamma=2.2, samples=2, psf_px=0.4)
"""As a monitor shows it; four rays at edges, since the video's colours are coarser than that."""


class StepPictures:
    """The pictures of one step; what its cameras share is prepared once."""

    def __init__(
        self,
        cameras: Mapping[str, DemonstrationCamera],
        objects: Mapping[int, tuple[Mesh, Array]],
        joints_rad: Array,
        opening_m: float,
        T_table_base: Array,
        T_table_ee: Array,
        middle_xy: tuple[float, float],
    ) -> None:
        """Keep what is needed; nothing is rendered yet.

        Args:
            cameras: by name.
            objects: mesh and T_table_obj (4, 4) [m], by instance.
            joints_rad: (7,) [rad].
            opening_m: distance of the finger faces [m].
            T_table_base: (4, 4) [m].
            T_table_ee: (4, 4) the hand's grasp frame [m].
            middle_xy: middle of the scene on the table [m].
        """
        self._cameras, self._objects = cameras, objects
        self._joints, self._opening = joints_rad, opening_m
        self._T_table_base, self._T_table_ee = T_table_base, T_table_ee
        self._middle = middle_xy
        self._renderer: PhotoRenderer | None = None

    def look(self, name: str) -> Rgb:
        """Return the picture (H, W, 3) of a camera.

        Raises:
            KeyError: there is no camera of that name.
        """
        camera = self._cameras[name]
        if self._renderer is None:
            self._renderer = PhotoRenderer(self._placed(), LIGHTING)
        T = self._T_table_ee @ camera.T_frame_cam if camera.on_hand else camera.T_frame_cam
        return self._renderer.render(camera.intrinsics, T).rgb

    def _placed(self) -> list[PlacedMesh]:
        table = np.eye(4)
        table[:2, 3] = self._middle
        placed = [PlacedMesh(BACKGROUND, table_slab(), table)]
        placed += [PlacedMesh(i, mesh, T) for i, (mesh, T) in sorted(self._objects.items())]
        return placed + panda_meshes(self._joints, self._opening, self._T_table_base)


def drawn_mesh(mesh: Mesh) -> Mesh:
    """Return an object's mesh as small pictures need it."""
    import cv2

    if len(mesh.faces) > MOST_FACES:
        return simplified(mesh, FEWER_FACES)
    if mesh.texture is None or max(mesh.texture.shape[:2]) <= TEXTURE_PX:
        return mesh
    scale = TEXTURE_PX / max(mesh.texture.shape[:2])
    size = [max(1, round(scale * edge)) for edge in mesh.texture.shape[1::-1]]
    texture = cv2.resize(mesh.texture, size, interpolation=cv2.INTER_AREA)
    return replace(mesh, texture=np.asarray(texture, np.uint8))


def table_slab() -> Mesh:
    """Return the table: a closed box under the plane z = 0 [m]."""
    h, t = TABLE_M / 2, TABLE_THICKNESS_M
    corners = np.array([[x, y, z] for x in (-h, h) for y in (-h, h) for z in (-t, 0.0)])
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    return Mesh(vertices=corners, faces=np.array(faces, dtype=np.int32))
