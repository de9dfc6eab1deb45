"""The simulated lab: an arm, a camera in its hand, a table, a tag board and objects.

It stands behind the same device protocols as the hardware, so that a capture cannot tell. What the
pipeline may know is `board`, `models`, `nominal_T_ee_cam` and what the devices report; everything
else is in `truth`, which exists to be written for the report, into a folder beside the session.

The simulated arm and the D405 in its hand, as the devices that a capture asks.

Colour and depth share one pixel grid, as on the D405 whose colour comes from its stereo module.
The images are made by the true, distorted lens; the intrinsics it reports are the factory's.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.parts import object_model, part_names
from realsim.records import Mesh, ObjectModel, ObjectPose, TagBoard
from realsim.robots.arm import UR5, find_arm
from realsim.robots.kinematics import DhChain
from realsim_capture_plans.devices.interfaces import Arm, ArmState, Frame, checked_goal
from realsim_capture_plans.lab import truth as lab_truth
from realsim_capture_plans.lab.placement import CrowdedError, place_objects
from realsim_capture_plans.lab.truth import NOISE, LabConfig, LabTruth, factory_intrinsics, stream
from realsim_capture_plans.planning.advise import LONG_ARM_M
from realsim_capture_plans.planning.elbow import reach_m
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


BOARD = TagBoard(rows=5, columns=7, tag_size_m=0.03, gap_m=0.01)
"""270 x 190 mm of tags: what an A4 sheet holds."""
BOARD_MARGIN_M = 0.0125
"""White paper around the tags [m]."""
BOARD_HEIGHT_M = 0.005
"""Height of the board's middle over the table [m]: it is glued to a plate."""
BOARD_TILT_DEG = 0.5
"""Angle by which the plate rocks on the table [deg]."""
TABLE_CENTER = (0.45, 0.0)
"""Middle of the work space in base [m]: where most arms reach most of a hemisphere; before an
arm shorter than `LONG_ARM_M` it lies nearer."""
TABLE_SIZE_M = (1.3, 1.5, 0.03)
"""Slab of the table: depth, width, thickness [m]."""
SINGLE_SURFACE_MESHES = ("bunny", "blob_033")
"""PyBullet's meshes that the lab draws by itself: the others are overlapping closed pieces, whose
volume, and so their mass, counts the overlaps twice. They can be named in `objects`."""
AIM_HEIGHT_M = 0.03
"""Height of the point to look at over the table [m]: half of a typical object."""


class SimulatedLab:
    """An arm with a D405 at a table, in software. The same seed gives the same bytes."""

    def __init__(self, config: LabConfig | None = None) -> None:
        """Furnish the lab; the table is empty at first.

        Args:
            config: what stands in it; None is `LabConfig()`.

        Raises:
            InputError: a part is not known, or the objects do not fit onto the table.
        """
        config = config or LabConfig()
        self.config = config
        self.board = BOARD
        self.nominal_T_ee_cam = lab_truth.T_EE_CAM_NOMINAL.copy()
        self.table_height = 0.0
        nominal = find_arm(config.arm).chain
        self._middle = np.array([*TABLE_CENTER, self.table_height])
        self._middle[0] *= min(1.0, reach_m(nominal) / LONG_ARM_M)
        self.scene_center = self._middle + np.array([0.0, 0.0, AIM_HEIGHT_M])
        instances = _instances(config)
        self.models: dict[int, ObjectModel] = {m.obj_id: m for m in instances}
        self.truth = self._build_truth(instances)
        self.arm = SimulatedArm(nominal)
        self._on_table: Sequence[PlacedMesh] = self._table_only()
        self.camera = SimulatedDepthCamera(config, self.truth, self.arm, lambda: self._on_table)

    def _build_truth(self, instances: Sequence[ObjectModel]) -> LabTruth:
        config = self.config
        Ts = _layout(config, instances, self._middle)
        return LabTruth(
            seed=config.seed,
            T_ee_cam=lab_truth.true_mount(config),
            intrinsics=lab_truth.true_intrinsics(config),
            chain=lab_truth.true_chain(config),
            repeat_m=config.repeat_mm / 1e3,
            repeat_rad=float(np.radians(config.repeat_deg)),
            objects=tuple(
                ObjectPose(obj_id=m.obj_id, instance=k, T_world_obj=T)
                for k, (m, T) in enumerate(zip(instances, Ts, strict=True))
            ),
            T_world_board=self._board_pose(),
            table_height_m=self.table_height,
        )

    def _board_pose(self) -> Array:
        """Return the board (4, 4) in the middle of the table, face up, a little turned."""
        rng = lab_truth.stream(self.config.seed, lab_truth.BOARD)
        yaw = rng.uniform(-0.3, 0.3)
        tilt = np.radians(BOARD_TILT_DEG) * rng.uniform(-1, 1, size=2)
        # x along the base's y axis: the board's long side lies across the arm's reach.
        face_up = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
        R = se3.exp_so3([0.0, 0.0, yaw]) @ se3.exp_so3([*tilt, 0.0]) @ face_up
        middle = np.array([*self.board.size_m, 0.0]) / 2
        center = self._middle + np.array([0.0, 0.0, BOARD_HEIGHT_M])
        return se3.from_rt(R, center - R @ middle)

    def _table_only(self) -> list["PlacedMesh"]:
        from realsim.rendering.rays import BACKGROUND, PlacedMesh

        slab = _slab(TABLE_SIZE_M)
        below = se3.from_translation([*TABLE_CENTER, self.table_height - TABLE_SIZE_M[2] / 2])
        return [PlacedMesh(BACKGROUND, slab, below)]

    def clear(self) -> None:
        """Take everything off the table."""
        self._on_table = self._table_only()

    def place_board(self) -> None:
        """Lay the calibration board onto the empty table."""
        from realsim.rendering.board import board_mesh
        from realsim.rendering.rays import BACKGROUND, PlacedMesh

        sheet = board_mesh(self.board, BOARD_MARGIN_M)
        paper = PlacedMesh(BACKGROUND, sheet, self.truth.T_world_board)
        self._on_table = [*self._table_only(), paper]

    def place_objects(self) -> None:
        """Put the objects onto the empty table."""
        from realsim.rendering.rays import PlacedMesh

        self._on_table = [
            *self._table_only(),
            *(
                PlacedMesh(o.instance, self.models[o.obj_id].mesh, o.T_world_obj)
                for o in self.truth.objects
            ),
        ]

    def operator_starts(self, rng: np.random.Generator) -> list[ObjectPose]:
        """Return the rough poses that a person would give: which object, about where, about how.

        This is the simulated operator: the truth, turned and shifted by a normal angle and a
        normal distance of `operator_deg` and `operator_mm`, each in a random direction.
        """
        starts: list[ObjectPose] = []
        for o in self.truth.objects:
            angle = np.radians(self.config.operator_deg) * rng.normal()
            distance = self.config.operator_mm / 1e3 * rng.normal()
            T = o.T_world_obj @ lab_truth.offset(rng, distance, angle)
            starts.append(ObjectPose(obj_id=o.obj_id, instance=o.instance, T_world_obj=T))
        return starts

    def write_truth(self, folder: Path | str, views: Mapping[int, ArrayLike] | None = None) -> Path:
        """Write the ground truth to FOLDER/truth.json and return the file.

        Args:
            folder: a folder of its own, beside the session and never in it.
            views: {number: joints (n,)} of the captured views, whose true camera poses are then
                written too. They follow from the seed and the joints, so they may also come from
                a session that another process captured.
        """
        return lab_truth.write_truth(folder, lab_truth.with_views(self.truth, views or {}))


def _instances(config: LabConfig) -> list[ObjectModel]:
    """Return the model of every instance."""
    names = config.objects
    if names is None:
        available = (*part_names(), *SINGLE_SURFACE_MESHES)
        if config.n_objects > len(available):
            raise InputError(
                f"{config.n_objects} different objects were asked for; there are "
                f"{len(available)}. Name them in `objects`, where a name may stand more than once."
            )
        rng = lab_truth.stream(config.seed, lab_truth.LAYOUT)
        drawn = rng.choice(len(available), size=config.n_objects, replace=False)
        names = tuple(available[k] for k in drawn)
    return [object_model(name) for name in names]


def _layout(config: LabConfig, instances: Sequence[ObjectModel], center: Array) -> Array:
    """Return where the instances stand (n, 4, 4), in the least disc that takes them.

    Raises:
        InputError: they do not fit into the widest either.
    """
    *narrow, widest = config.disc_radii_m
    for radius in narrow:
        rng = lab_truth.stream(config.seed, lab_truth.LAYOUT)
        try:
            return place_objects(instances, center, rng, radius)
        except CrowdedError:
            continue
    rng = lab_truth.stream(config.seed, lab_truth.LAYOUT)
    return place_objects(instances, center, rng, widest)


def _slab(size_m: tuple[float, float, float]) -> Mesh:
    """Return a plain box about the origin; without colours a background is rendered as wood."""
    from realsim.geometry import parts_solids as solids

    x, y, z = size_m
    vertices, faces = solids.weld([solids.extrude(solids.rectangle(x, y), -z / 2, z / 2)])
    return Mesh(vertices=vertices, faces=faces)
