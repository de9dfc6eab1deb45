"""Where everything stands during a fit, one step of it, and what is known of it before."""

from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array, Int32
from realsim.geometry import se3
from realsim.registration.refinement.equations import OBJECTS, State, object_at, step_state
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.evidence import ScanEvidence, ScanView

OBJECT = object_at(0)
SIZE, RIM, PATCHES = OBJECTS + 6, OBJECTS + 7, OBJECTS + 8
"""Where the unknowns stand that a scale fit adds to registration's: the logarithm of the size, the
outlines' offset, and the offsets of the patches of the surface."""
SIMILARITY = np.array([*OBJECT, SIZE])
LARGEST_SCALE_STEP = 0.2
"""No step changes the scale by more than this factor: without a bound far starts collapse."""
LARGEST_TURN_RAD = 0.35
"""Largest turn of the object in a step [rad]: the equations are linear."""
LEAST_SIGMA = (np.radians(1e-3), 1e-5)
"""Least prior 1-sigma of a camera's turn [rad] and shift [m]: none is perfect."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ScaleState(State):
    """Registration's state of one object, whose size is unknown too."""

    s: float
    """Scale of the inner mesh."""
    rim: float = 0.0
    """By how much outlines lie outside of the true ones [px]."""

    @property
    def R(self) -> Array:
        """(3, 3) of the object."""
        return self.poses[0, :3, :3]

    @property
    def t(self) -> Array:
        """(3,) centre of the object's box in world [m]."""
        return self.poses[0, :3, 3]

    @property
    def table(self) -> Array:
        """(4, 4) T_world_table, which a scale fit always has."""
        assert self.T_world_table is not None, "a scan has a table"
        return self.T_world_table

    @property
    def bias_per_m(self) -> float:
        """Error of the depth, c of dz = c z^2 [1/m]."""
        return -float(self.bias[1])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Priors:
    """What the cameras' errors may be: 1-sigma of twists [rad, m]."""

    hand_eye: Array
    """(6,)."""
    arm: Array
    """(6,)."""


def priors_of(config: ScaleConfig) -> Priors:
    """Return the cameras' priors: the session's own, or the defaults."""
    p = config.prior

    def twist(deg: float | None, deg_else: float, mm: float | None, mm_else: float) -> Array:
        turn = np.radians(deg_else if deg is None else deg)
        shift = (mm_else if mm is None else mm) / 1e3
        return np.repeat([max(turn, LEAST_SIGMA[0]), max(shift, LEAST_SIGMA[1])], 3)

    return Priors(
        hand_eye=twist(
            config.hand_eye_sigma_deg, p.hand_eye_deg, config.hand_eye_sigma_mm, p.hand_eye_mm
        ),
        arm=twist(config.arm_sigma_deg, p.arm_deg, config.arm_sigma_mm, p.arm_mm),
    )


def first_state(evidence: ScanEvidence, s: float, T_world_obj: Array) -> ScaleState:
    """Return the state of an object pose (4, 4) with everything else as it is said to be."""
    return ScaleState(
        s=s, poses=np.array(T_world_obj, dtype=np.float64)[None], hand_eye=np.zeros(6),
        views=np.zeros((len(evidence.views), 6)), bias=np.array([1.0, 0.0]),
        T_world_table=evidence.plane.T_world_table.copy(),
    )  # fmt: skip


def claimed_cameras(views: tuple[ScanView, ...]) -> Array:
    """Return the cameras (V, 4, 4) as they are said to be."""
    return np.stack([v.T_world_cam for v in views])


def moved_state(state: ScaleState, shared: Array, views: Array) -> ScaleState:
    """Return the state after the step of the shared unknowns (S,) and the views (V, 6), bounded."""
    x = shared.copy()
    turn, growth = float(np.linalg.norm(x[OBJECT[:3]])), abs(float(x[SIZE]))
    x[SIMILARITY] *= min(
        1.0, LARGEST_SCALE_STEP / max(growth, 1e-12), LARGEST_TURN_RAD / max(turn, 1e-12)
    )
    cameras = step_state(replace(state, poses=state.poses[:0]), [], x, views)
    assert isinstance(cameras, ScaleState)
    return replace(
        cameras, poses=state.poses @ se3.exp(x[OBJECT]), s=state.s * float(np.exp(x[SIZE])),
        rim=state.rim + float(x[RIM]),
    )  # fmt: skip


def stacked(points: list[Array]) -> tuple[Array, Int32]:
    """Return the points of all views in one piece, and which view each is of."""
    counts = [len(p) for p in points]
    return np.concatenate(points), np.repeat(np.arange(len(points), dtype=np.int32), counts)


def metre_per_px(evidence: ScanEvidence, T_world_cam: Array) -> float:
    """Return the size of a pixel at the object [m]."""
    low, high = evidence.footprint.box
    middle = se3.transform(evidence.plane.T_world_table, 0.5 * (low + high))[0]
    z = float((middle - T_world_cam[:3, 3]) @ T_world_cam[:3, 2])
    return max(z, 0.05) / evidence.intrinsics.fx
