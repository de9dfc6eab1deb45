"""The simulated arm and the D405 in its hand, as the devices that a capture asks.

Colour and depth share one pixel grid, as on the D405 whose colour comes from its stereo module.
The images are made by the true, distorted lens; the intrinsics it reports are the factory's.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.robots.arm import UR5, find_arm
from realsim.robots.kinematics import DhChain
from realsim_capture_plans.devices.interfaces import Arm, ArmState, Frame, checked_goal
from realsim_capture_plans.lab.truth import NOISE, LabConfig, LabTruth, factory_intrinsics, stream
from realsim_capture_plans.planning.ordering import move_seconds

if TYPE_CHECKING:
    from realsim.rendering.depth_camera import DepthCamera
    from realsim.rendering.photo import PhotoRenderer
    from realsim.rendering.rays import PlacedMesh


class SimulatedArm:
    """An arm without errors of its own knowledge: the errors are in where it really stands.

    The reported pose is the nominal forward kinematics of the commanded joints. The true flange,
    which only the lab's truth knows, is elsewhere by the errors of the chain and the repeatability.
    Time is simulated: a move lasts as long as moveJ's trapezoid of its leading joint.
    """

    def __init__(self, chain: DhChain = UR5) -> None:
        """Switch the arm on at its home position."""
        self._chain = chain
        self._joints = np.array(find_arm(chain.name).home)
        self._time_s = 0.0
        self.name, self.limits = chain.name, chain.limits
        self.description: dict[str, Any] = {"model": chain.name, "simulated": True}

    def recover(self) -> None:
        """Do nothing: this arm never stops by itself."""

    def move(self, joints: ArrayLike, speed: float = 1.05, acceleration: float = 1.4) -> None:
        """Go to joints (n,) [rad] at the speed [rad/s] and acceleration [rad/s^2] of moveJ.

        Raises:
            InputError: the goal is not n finite angles within the limits; the arm has not moved.
        """
        goal = checked_goal(joints, self.limits)
        way = np.abs(goal - self._joints).max()
        self._time_s += float(move_seconds(way, speed, acceleration))
        self._joints = goal

    def state(self) -> ArmState:
        """Return where the arm believes it is."""
        return ArmState(
            joints=self._joints, T_base_ee=self._chain.forward(self._joints), time_s=self._time_s
        )


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
        self._depth = _depth_camera(config)
        self._seen: Sequence[PlacedMesh] | None = None
        self._renderer: PhotoRenderer | None = None
        self._frames = 0
        self.name = f"simulated D405 {config.seed:06d}"
        self.intrinsics = factory_intrinsics(config)
        """The factory's camera model: near the truth, and without its distortion."""
        self.depth_unit_m = DEPTH_UNIT_M
        self.description: dict[str, Any] = {"name": self.name, "simulated": True}

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
            depth_m=self._depth.measure(self._truth.intrinsics, T_world_cam, rng, photo),
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


def _depth_camera(config: LabConfig) -> "DepthCamera":
    """Return what measures the depth of the exact photographs, in whole counts."""
    from realsim.rendering.depth_camera import DepthCamera
    from realsim.rendering.depth_sensors.model import DepthSensorModel

    sensor = DepthSensorModel() if config.depth_noise else DepthSensorModel.noiseless()
    sensor = replace(sensor, bias_px=config.disparity_bias_px)
    return DepthCamera(sensor=sensor, unit_m=DEPTH_UNIT_M)
