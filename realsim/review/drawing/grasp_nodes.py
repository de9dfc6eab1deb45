"""Grasps in a browser: thousands of grippers as one batched mesh, and which of them is clicked."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import viser

from realsim.arrays import Array, Rows
from realsim.interop import viser_wxyz_position
from realsim.records import GraspSet
from realsim.rendering.overlay import grasp_rgb
from realsim.review.drawing.grasp_drawing import gripper_mesh, gripper_scales, linear_rgb

NAME = "/grasps"


class GraspNodes:
    """The grasps drawn in one scene."""

    def __init__(self, api: viser.SceneApi) -> None:
        """Draw nothing yet."""
        self._api = api
        self._node: viser.BatchedMeshHandle | None = None
        self.drawn: list[tuple[int, int]] = []
        """Instance and row of every gripper, in the order of the batch."""
        self._on_click: Callable[[int, int], None] = lambda instance, row: None

    def draw(
        self, found: Sequence[tuple[GraspSet, Rows]], Ts_world_obj: Mapping[int, Array]
    ) -> int:
        """Draw these rows of these sets instead of those before; return how many."""
        self.clear()
        if not found:
            return 0
        Ts = [Ts_world_obj[g.instance] @ g.Ts_obj_grasp[rows] for g, rows in found]
        wxyzs, positions = viser_wxyz_position(np.concatenate(Ts))
        widths = np.concatenate([g.widths_m[rows] for g, rows in found])
        rgb = np.concatenate([grasp_rgb(g, rows) for g, rows in found])
        vertices, faces = gripper_mesh()
        self.drawn = [(g.instance, int(row)) for g, rows in found for row in rows]
        # Off: of two dozen triangles nothing can be left out.
        self._node = self._api.add_batched_meshes_simple(
            NAME, vertices, faces, wxyzs, positions, batched_scales=gripper_scales(widths),
            batched_colors=linear_rgb(rgb), lod="off", flat_shading=True,
            side="double", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        drawn = self.drawn

        def clicked(event: Any) -> None:
            index = event.instance_index
            if index is not None and 0 <= index < len(drawn):
                self._on_click(*drawn[index])

        self._node.on_click(clicked)
        return len(self.drawn)

    def on_click(self, callback: Callable[[int, int], None]) -> None:
        """Call back with instance and row of a grasp that is clicked."""
        self._on_click = callback

    def clear(self) -> None:
        """Draw none."""
        if self._node is not None:
            self._node.remove()
            self._node = None
        self.drawn = []
