"""The nodes of a replay in viser: links, a plain hand of boxes, and the object that is carried."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import viser

from realsim.geometry import mesh as mesh_tools
from realsim.interop import viser_wxyz_position
from realsim.records import Mesh
from realsim.records.checked_arrays import Array
from realsim.robots.hand import Hand

PLAIN_RGB = (176, 182, 190)
"""Colour of what has none of its own."""
HAND_RGB = (222, 226, 232)
"""Colour of the plain hand: light lacquer, which stands out from the grasps' colours."""
BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]], dtype=np.int32,
)  # fmt: skip
"""(12, 3) of the corners in the order z fastest, outward."""


class ReplayNodes:
    """What is drawn of a motion; only positions and orientations change while it plays."""

    def __init__(self, scene: viser.SceneApi, name: str, hand: Hand) -> None:
        """Start with nothing drawn.

        Args:
            scene: of a server or of one client.
            name: of the node under which everything is.
            hand: sizes of the plain hand.
        """
        self._scene, self._name, self._hand = scene, name, hand
        self._links: list[Any] = []
        self._boxes: list[Any] = []
        """Palm, finger at +y, finger at -y; empty where the links hold the hand."""
        self._object: Any = None
        self._arm_links, self._arm_shown = 0, True

    def draw(self, link_meshes: Sequence[Mesh], obj_mesh: Mesh | None, arm_links: int = 0) -> None:
        """Draw these meshes in place of those before; hidden until they are put somewhere.

        Args:
            link_meshes: (L,) of arm and hand; none = the plain hand.
            obj_mesh: of what is carried; None = nothing.
            arm_links: how many of the first links are the arm.
        """
        self.clear()
        self._arm_links = arm_links
        for k, mesh in enumerate(link_meshes):
            self._links.append(self._add(f"link_{k}", mesh))
        if not link_meshes:
            palm, right, left = self._hand.boxes(0.0)[0]
            for part, box in (("palm", palm), ("finger_left", left), ("finger_right", right)):
                self._boxes.append(self._add_box(part, *box))
        if obj_mesh is not None:
            self._object = self._add("object", obj_mesh)

    def put(
        self, Ts_world_link: Array, T_world_hand: Array, opening_m: float, T_world_obj: Array | None
    ) -> None:
        """Put everything in its place.

        Args:
            Ts_world_link: (L, 4, 4) [m].
            T_world_hand: (4, 4) the grasp frame [m].
            opening_m: distance of the finger faces [m].
            T_world_obj: (4, 4) the carried object [m]; None = it is not drawn.
        """
        for k, (node, T) in enumerate(zip(self._links, Ts_world_link, strict=True)):
            _place(node, T, shown=self._arm_shown or k >= self._arm_links)
        for node, side in zip(self._boxes, (0, 1, -1), strict=False):
            T = np.array(T_world_hand)
            T[:3, 3] += T[:3, 1] * side * opening_m / 2.0
            _place(node, T)
        if self._object is not None:
            if T_world_obj is not None:
                _place(self._object, T_world_obj)
            elif self._object.visible:
                self._object.visible = False

    def show_arm(self, shown: bool) -> None:
        """Show or hide the arm; the hand stays."""
        self._arm_shown = shown
        for node in self._links[: self._arm_links]:
            node.visible = shown

    def clear(self) -> None:
        """Take everything away."""
        for node in (*self._links, *self._boxes, *([self._object] if self._object else [])):
            node.remove()
        self._links, self._boxes, self._object = [], [], None

    def _add(self, part: str, mesh: Mesh) -> Any:
        """Add a mesh in its own colours."""
        from trimesh.visual import ColorVisuals

        shape = mesh_tools.to_trimesh(mesh)
        colors = mesh_tools.vertex_colors(mesh)
        if colors is None:
            colors = np.tile(np.array(PLAIN_RGB, dtype=np.uint8), (len(mesh.vertices), 1))
        shape.visual = ColorVisuals(shape, vertex_colors=colors)
        return self._scene.add_mesh_trimesh(
            f"{self._name}/{part}", shape, cast_shadow=False, visible=False
        )

    def _add_box(self, part: str, low: Array, high: Array) -> Any:
        corners = np.stack(np.meshgrid(*np.stack([low, high], axis=1), indexing="ij"), axis=-1)
        return self._scene.add_mesh_simple(
            f"{self._name}/{part}",
            corners.reshape(-1, 3).astype(np.float32),
            BOX_FACES,
            color=HAND_RGB,
            flat_shading=True,
            side="double",
            cast_shadow=False,
            visible=False,
        )


def _place(node: Any, T: Array, shown: bool = True) -> None:
    """Move a node; the first time it appears, too."""
    node.wxyz, node.position = viser_wxyz_position(T)
    if node.visible is not shown:
        node.visible = shown
