"""Pictures of a step: table, objects and arm, rendered by the embedded renderer when asked for."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from realsim.models.simplify import simplified
from realsim.records import Mesh
from realsim.rendering.photo import Lighting, PhotoRenderer
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim_sim_bridge.demonstrations.panda_looks import panda_meshes
from realsim_sim_bridge.demonstrations.records import DemonstrationCamera, Rgb

Array = NDArray[np.float64]
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
