"""The simulated D405 in the arm's hand: photographs and noisy depth of what is on the table.

Colour and depth share one pixel grid, as on the D405 whose colour comes from its stereo module.
The images are made by the true, distorted lens; the intrinsics it reports are the factory's.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from realsim.records import CameraIntrinsics
from realsim_capture_plans.devices.interfaces import Arm, Frame
from realsim_capture_plans.lab.truth import NOISE, LabConfig, LabTruth, factory_intrinsics, stream

if TYPE_CHECKING:
    from realsim.rendering.photo import PhotoRenderer
    from realsim.rendering.rays import PlacedMesh

Array = NDArray[np.float64]

DEPTH_UNIT_M = 1e-4
"""Metres per count of the D405's depth (its driver's default)."""
FRAME_S = 1 / 30
"""Time of one frame [s]."""


class SimulatedDepthCamera:
    """A D405 without hardware."""

    def __init__(
        self,
        config: LabConfig,
        truth: LabTruth,
        arm: Arm,
        table: Callable[[], Sequence["PlacedMesh"]],
    ) -> None:
        """Mount the camera.

        Args:
            config: sizes of the camera's errors.
            truth: where the camera really stands at given joints, and its true lens.
            arm: the arm that carries it.
            table: what is on the table at the time of a frame; the same list object as long as
                nothing has changed.
        """
        self._config = config
        self._truth = truth
        self._arm = arm
        self._table = table
        self._factory = factory_intrinsics(config)
        self._seen: Sequence[PlacedMesh] | None = None
        self._renderer: PhotoRenderer | None = None
        self._frames = 0

    @property
    def name(self) -> str:
        """Model and serial number."""
        return f"simulated D405 {self._config.seed:06d}"

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """The factory's camera model: near the truth, and without its distortion."""
        return self._factory

    @property
    def depth_unit_m(self) -> float:
        """Metres per count of the sensor's own 16-bit depth."""
        return DEPTH_UNIT_M

    @property
    def description(self) -> dict[str, Any]:
        """What is kept with the session."""
        return {"name": self.name, "simulated": True}

    def grab(self) -> Frame:
        """Return a frame of what is on the table.

        The noise is that of the arm's stop: the same joints and table give the same frame, bit for
        bit, so that a resumed capture equals an uninterrupted one.
        """
        state = self._arm.state()
        renderer = self._current_renderer()
        rng = stream(self._config.seed, NOISE, state.joints)
        T_world_cam = self._truth.T_world_cam(state.joints)
        photo = renderer.render(
            self._truth.intrinsics, T_world_cam, rng if self._config.image_noise else None
        )
        self._frames += 1
        return Frame(
            rgb=photo.rgb,
            depth_m=self._measured(photo.depth_m, rng),
            time_s=state.time_s + self._frames * FRAME_S,
        )

    def recover(self) -> None:
        """Do nothing: a simulated camera is always ready."""

    def _current_renderer(self) -> "PhotoRenderer":
        """Return the renderer of what is on the table now; built anew when that changes."""
        from realsim.rendering.photo import PhotoRenderer

        placed = self._table()
        if self._renderer is None or placed is not self._seen:
            self._renderer, self._seen = PhotoRenderer(placed), placed
        return self._renderer

    def _measured(
        self, depth_m: NDArray[np.float32], rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """Return the depth (H, W) [m] as the sensor measures it, in whole counts."""
        from realsim.rendering.depth_sensors.model import DepthSensorModel

        sensor = DepthSensorModel() if self._config.depth_noise else DepthSensorModel.noiseless()
        sensor = replace(sensor, bias_px=self._config.disparity_bias_px)
        counts = np.round(sensor.measure(depth_m, self._truth.intrinsics, rng) / DEPTH_UNIT_M)
        return (counts * DEPTH_UNIT_M).astype(np.float32)
