"""Depth of a sensor of its own on the pixels of the colour camera beside it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.geometry.camera import ray_table
from realsim.records import CameraIntrinsics
from realsim_capture_plans.devices.realsense_pairs import Pair

ALIGN_MS = 1000
"""Waited for the SDK's alignment of one frame [ms], which takes about 20."""


class Alignment:
    """Brings depth to the colour camera: its pixels by the SDK, its z axis by us."""

    def __init__(self, rs: Any, color: CameraIntrinsics, T_color_depth: NDArray[Any]) -> None:
        """Prepare the alignment.

        Args:
            rs: the module pyrealsense2.
            color: the colour camera.
            T_color_depth: (4, 4) depth camera in the colour camera [m].
        """
        self._align = rs.align(rs.stream.color)
        self._queue = rs.frame_queue(2)
        self._color: list[Any] = []
        color_frame = self._color  # the SDK keeps the function, which must not keep this object

        def join(depth: Any, source: Any) -> None:
            source.frame_ready(source.allocate_composite_frame([depth, color_frame[0]]))

        self._join = rs.processing_block(join)
        self._join.start(self._queue)
        # The SDK moves a pixel's depth to the colour's pixel but leaves it along the depth
        # camera's axis. With z_d = a . (z r - t), a = R's third column, r the colour pixel's ray:
        axis, t = T_color_depth[:3, 2], T_color_depth[:3, 3]
        along = ray_table(color) @ axis
        self._scale = np.nan_to_num(1.0 / along, nan=0.0).astype(np.float32)
        self._offset = float(axis @ t)

    def depth_m(self, pair: Pair, unit_m: float) -> NDArray[np.float32]:
        """Return the depth (H, W) [m] on the colour image's pixels, along its z axis."""
        self._color[:] = [pair.color]
        self._join.invoke(pair.depth)
        frames = self._queue.wait_for_frame(ALIGN_MS).as_frameset()
        self._color.clear()
        aligned = self._align.process(frames).get_depth_frame()
        depth = np.asanyarray(aligned.get_data()) * np.float64(unit_m)
        return np.where(depth > 0, (depth + self._offset) * self._scale, 0).astype(np.float32)
