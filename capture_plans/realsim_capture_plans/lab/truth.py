"""What the simulated lab knows and the pipeline is never told, and the sizes of its errors.

Everything follows from the seed: the true hand-eye, the arm's true chain, the true lens, the
objects' true poses. Even the arm's repeatability is a function of the seed and the joints, so that
a capture that was killed and resumed sees the very images it would have seen in one go.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import CameraIntrinsics, ObjectPose
from realsim.robots.arm import find_arm
from realsim.robots.kinematics import DhChain
from realsim.untrusted.own_json import OwnFile, read_own, to_json

TRUTH_FILE = "truth.json"
T_EE_CAM_NOMINAL = se3.from_translation([0.0, -0.065, 0.035])
"""(4, 4) the mount as drawn [m]: the optical axis along the tool's z, 65 mm beside it."""
FACTORY_WIDTH_PX = 1280
FACTORY_FOCAL_PX = 648.0
"""Focal length at 1280 pixels of width [px]: the D405's 87 deg less its rectification's rim."""
JOINT_STEP_RAD = 1e-7
"""Joint angles nearer than this are the same stop for the repeatability [rad]."""

# Streams of random numbers: one for each unknown, so that changing one leaves the others alone.
_MOUNT, _CHAIN, _LENS, _REPEAT, NOISE, LAYOUT, BOARD = range(7)


@dataclass(frozen=True, kw_only=True, slots=True)
class LabConfig:
    """What stands in the lab, and how large its errors are (one sigma unless said otherwise)."""

    seed: int = 0
    """Everything else follows from it."""
    arm: str = "UR5"
    """Name or folder of the arm."""
    n_objects: int = 5
    """Objects on the table, drawn from the shipped parts and PyBullet's meshes."""
    objects: tuple[str, ...] | None = None
    """Names of the objects, one for each instance; None draws `n_objects` different ones."""
    width: int = 1280
    """Image width [px]."""
    height: int = 720
    """Image height [px]."""
    radius_m: float | None = None
    """Radius of the disc of objects [m]; None: the least of `disc_radii_m` into which they fit."""
    mount_mm: float = 3.0
    """Length of the true mount's offset from the drawing [mm]: a printed bracket."""
    mount_deg: float = 1.0
    """Angle of the true mount's turn from the drawing [deg]."""
    joint_offset_mrad: float = 0.2
    """Error of each joint's zero [mrad]: a UR after factory calibration."""
    link_mm: float = 0.1
    """Error of each link length and offset [mm]."""
    repeat_mm: float = 0.03
    """Repeatability along each axis [mm]; the UR5's data sheet says 0.1 at most."""
    repeat_deg: float = 0.01
    """Repeatability about each axis [deg]."""
    focal_percent: float = 0.3
    """Error of the factory's focal length [%]."""
    center_px: float = 3.0
    """Error of the factory's principal point at 1280 pixels of width [px]."""
    distortion: tuple[float, float, float, float, float] = (-0.05, 0.05, 3e-4, 3e-4, 0.005)
    """Size of k1 k2 p1 p2 k3: k1, k2 are this within 20 %, the others random of this sigma. The
    factory's model says zero."""
    disparity_bias_px: float = 0.01
    """Constant error of the depth sensor's disparity [px]: a thermal drift of the stereo pair."""
    depth_noise: bool = True
    """Whether the depth sensor has noise and holes."""
    image_noise: bool = True
    """Whether the photographs have noise."""
    operator_mm: float = 8.0
    """Distance of the operator's rough object pose from the truth [mm]."""
    operator_deg: float = 8.0
    """Angle of the operator's rough object pose from the truth [deg]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.seed < 0:
            raise InputError(f"the lab's seed is {self.seed}; it must be 0 or more.")
        if self.n_objects < 1 or (self.objects is not None and not self.objects):
            raise InputError("the lab needs at least one object.")
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name.endswith(("_mm", "_deg", "_px", "_mrad", "_percent")) and not value >= 0:
                raise InputError(f"the lab's {f.name} is {value}; a size of 0 or more is needed.")

    @property
    def disc_radii_m(self) -> tuple[float, ...]:
        """Radii of the disc of objects to be tried [m].

        0.057 sqrt(n) leaves half of the disc free for parts of average size; bulky ones get more.
        """
        if self.radius_m is not None:
            return (self.radius_m,)
        n = self.n_objects if self.objects is None else len(self.objects)
        least = max(0.14, 0.057 * float(np.sqrt(n)))
        return tuple(least * growth for growth in (1.0, 1.1, 1.2, 1.35))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TrueView:
    """Where the camera really was in one captured view."""

    index: int
    """Number of the view in its session."""
    joints: Array
    """(n,) commanded joints [rad]."""
    T_world_cam: Array
    """(4, 4) true camera in world [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LabTruth:
    """The ground truth of a simulated lab."""

    seed: int
    T_ee_cam: Array
    """(4, 4) true camera in the flange [m]."""
    intrinsics: CameraIntrinsics
    """True camera, lens distortion included."""
    chain: DhChain
    """The arm as it was really built: its deltas are its errors."""
    repeat_m: float
    """Repeatability along each axis of the flange [m]."""
    repeat_rad: float
    """Repeatability about each axis of the flange [rad]."""
    objects: tuple[ObjectPose, ...]
    """True pose of every instance."""
    T_world_board: Array
    """(4, 4) true board in world [m]."""
    table_height_m: float
    """Height of the table's surface in world [m]."""
    views: tuple[TrueView, ...] = ()
    """The captured views that were asked for when the truth was written."""

    def T_base_ee(self, joints: ArrayLike) -> Array:
        """Return where the flange (4, 4) [m] really stands at commanded joints (n,) [rad]."""
        q = np.asarray(joints, dtype=np.float64)
        noise = stream(self.seed, _REPEAT, q).normal(size=6)
        noise *= np.repeat([self.repeat_rad, self.repeat_m], 3)
        return self.chain.forward(q) @ se3.exp(noise)

    def T_world_cam(self, joints: ArrayLike) -> Array:
        """Return where the camera (4, 4) [m] really stands at commanded joints (n,) [rad]."""
        return self.T_base_ee(joints) @ self.T_ee_cam


def stream(seed: int, purpose: int, joints: Array | None = None) -> np.random.Generator:
    """Return the generator of one purpose, and of one stop of the arm if joints (n,) are given."""
    key = [seed, purpose]
    if joints is not None:
        # Shifted, because seeds are not negative and joints are.
        key += [int(v) + 2**40 for v in np.round(joints / JOINT_STEP_RAD)]
    return np.random.default_rng(key)


def factory_intrinsics(config: LabConfig) -> CameraIntrinsics:
    """Return what the camera's maker says of it: square pixels, centred, no distortion."""
    f = FACTORY_FOCAL_PX * config.width / FACTORY_WIDTH_PX
    return CameraIntrinsics(
        width=config.width,
        height=config.height,
        fx=f,
        fy=f,
        cx=(config.width - 1) / 2,
        cy=(config.height - 1) / 2,
    )


def true_intrinsics(config: LabConfig) -> CameraIntrinsics:
    """Return the camera as it really is."""
    rng = stream(config.seed, _LENS)
    factory = factory_intrinsics(config)
    focal = 1 + config.focal_percent / 100 * rng.normal()
    center = config.center_px * config.width / FACTORY_WIDTH_PX * rng.normal(size=2)
    radial = 1 + 0.2 * rng.uniform(-1, 1, size=2)
    d = np.array(config.distortion) * np.concatenate([radial, rng.normal(size=3)])
    return replace(
        factory,
        fx=factory.fx * focal,
        fy=factory.fy * focal,
        cx=factory.cx + center[0],
        cy=factory.cy + center[1],
        distortion=d,
    )


def true_mount(config: LabConfig) -> Array:
    """Return the true camera in the flange (4, 4) [m]: the drawing, off in a random direction."""
    rng = stream(config.seed, _MOUNT)
    off = offset(rng, config.mount_mm / 1e3, np.radians(config.mount_deg))
    return T_EE_CAM_NOMINAL @ off


def true_chain(config: LabConfig) -> DhChain:
    """Return the arm as it was really built."""
    rng = stream(config.seed, _CHAIN)
    link = config.link_mm / 1e3
    nominal = find_arm(config.arm).chain
    n = nominal.joints
    return replace(
        nominal,
        delta_a=rng.normal(scale=1.0, size=n) * link,
        delta_d=rng.normal(scale=1.0, size=n) * link,
        delta_theta=rng.normal(scale=1.0, size=n) * config.joint_offset_mrad / 1e3,
    )


def offset(rng: np.random.Generator, distance_m: float, angle_rad: float) -> Array:
    """Return a transform (4, 4) of this length [m] and angle [rad] in random directions."""
    axes = rng.normal(size=(2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return se3.from_rt(se3.exp_so3(axes[0] * angle_rad), axes[1] * distance_m)


def with_views(truth: LabTruth, views: Mapping[int, ArrayLike]) -> LabTruth:
    """Return the truth with the true camera of every view {number: joints (n,)}."""
    rows: list[TrueView] = []
    for index, joints in sorted(views.items()):
        q = np.asarray(joints, dtype=np.float64)
        rows.append(TrueView(index=index, joints=q, T_world_cam=truth.T_world_cam(q)))
    return replace(truth, views=tuple(rows))


class _TruthFile(OwnFile, frozen=True, kw_only=True):
    """truth.json: of the chain its errors alone; T_a_b maps b to a."""

    format: Literal["realsim-lab-truth"] = "realsim-lab-truth"
    version: Literal[1] = 1
    units: str = "m, rad, px; T_a_b maps b to a"
    seed: int
    arm: str = "UR5"
    T_ee_cam: Array
    intrinsics: CameraIntrinsics
    chain: dict[str, Array]
    repeat_m: float
    repeat_rad: float
    objects: tuple[ObjectPose, ...]
    T_world_board: Array
    table_height_m: float
    views: tuple[TrueView, ...]


_DELTAS = ("delta_a", "delta_d", "delta_alpha", "delta_theta")
_AS_THEY_ARE = tuple(f.name for f in fields(LabTruth) if f.name != "chain")


def write_truth(folder: Path | str, truth: LabTruth) -> Path:
    """Write the truth to FOLDER/truth.json, whole or not at all, and return the file."""
    from realsim.store.atomic import write_json

    path = Path(folder) / TRUTH_FILE
    deltas = {name: getattr(truth.chain, name) for name in _DELTAS}
    same = {name: getattr(truth, name) for name in _AS_THEY_ARE}
    write_json(path, to_json(_TruthFile(arm=truth.chain.name, chain=deltas, **same)))
    return path


def load_truth(folder: Path | str) -> LabTruth:
    """Read FOLDER/truth.json. Only the report may: nothing that estimates opens it.

    Raises:
        InputError: there is no such file, or it is not a truth of this version.
    """
    path = Path(folder) / TRUTH_FILE
    if not path.is_file():
        raise InputError(f"there is no {TRUTH_FILE} in {folder}; only a simulated lab writes one.")
    found = read_own(path, _TruthFile)
    same = {name: getattr(found, name) for name in _AS_THEY_ARE}
    return LabTruth(chain=replace(find_arm(found.arm).chain, **found.chain), **same)
