"""The nodes of a replay in viser: links, a plain hand of boxes, and the object that is carried."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import viser

from realsim.arrays import Array
from realsim.geometry import mesh as mesh_tools
from realsim.geometry import se3
from realsim.interop import viser_wxyz_position
from realsim.records import Mesh
from realsim.robots.hand import Hand, find_hand

PLAIN_RGB = (176, 182, 190)
"""Colour of what has none of its own."""
HAND_RGB = (222, 226, 232)
"""Colour of the plain hand: light lacquer, which stands out from the grasps' colours."""


class ReplayNodes:
    """What is drawn of a motion; only positions and orientations change while it plays."""

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        """Start with nothing drawn.

        Args:
            scene: of a server or of one client.
            name: of the node under which everything is.
        """
        self._scene, self._name, self._hand = scene, name, find_hand()
        self._links: list[Any] = []
        self._boxes: list[Any] = []
        """As `Hand.boxes` has them; empty where the links hold the hand."""
        self._object: Any = None
        self._arm_links, self._arm_shown = 0, True

    def draw(
        self, link_meshes: Sequence[Mesh], obj_mesh: Mesh | None, hand: Hand, arm_links: int = 0
    ) -> None:
        """Draw these meshes in place of those before; hidden until they are put somewhere.

        Args:
            link_meshes: (L,) of arm and hand.
            obj_mesh: of what is carried; None = nothing.
            hand: drawn as boxes where no link is beyond the arm.
            arm_links: how many of the first links are the arm.
        """
        self.clear()
        self._arm_links, self._hand = arm_links, hand
        for k, mesh in enumerate(link_meshes):
            self._links.append(self._add(f"link_{k}", mesh))
        if len(link_meshes) == arm_links:
            for k, box in enumerate(self._hand.boxes(0.0)[0]):
                self._boxes.append(self._add_box(f"hand_{k}", *box))
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
        if self._boxes:
            # The boxes keep their sizes but for those around bars that turn, which are moved along.
            closed, now = (self._hand.boxes(w)[0].mean(axis=1) for w in (0.0, opening_m))
            for node, shift in zip(self._boxes, now - closed, strict=True):
                _place(node, T_world_hand @ se3.from_translation(shift))
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
        box = mesh_tools.box_mesh(low, high)
        return self._scene.add_mesh_simple(
            f"{self._name}/{part}", box.vertices.astype(np.float32), box.faces, color=HAND_RGB,
            flat_shading=True, side="double", cast_shadow=False, visible=False,
        )  # fmt: skip


def _place(node: Any, T: Array, shown: bool = True) -> None:
    """Move a node; the first time it appears, too."""
    node.wxyz, node.position = viser_wxyz_position(T)
    if node.visible is not shown:
        node.visible = shown
