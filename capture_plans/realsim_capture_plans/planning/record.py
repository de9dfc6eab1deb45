"""What a capture plan is, the numbers it is made with, and its content as JSON under a hash.

The content is what a plan is made of. What follows from it (flange and camera poses, corners and
times of the moves) is written beside it for other programs, and compared with the chain when the
file is read: it is no part of the hash, whose last bits it would make depend on the machine.
"""

import hashlib
import json
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.json_values import json_value
from realsim.records.checked_arrays import frozen
from realsim.robots.kinematics import DhChain
from realsim.robots.limits import JointLimits
from realsim.robots.shapes import Box, Mount, Shape, WorkCell
from realsim_capture_plans.collision.model import CollisionModel

LEAST_DEGREES = 2.0
"""A cap that ends below this elevation was given in radians [deg]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PlanConfig:
    """Where views may be, what must stay free, and how fast the arm goes."""

    radius_m: tuple[float, float] = (0.25, 0.45)
    """Camera to scene centre [m]. A D405's depth noise grows with z^2: 0.45 mm at 0.25 m, 1.4 mm
    at 0.45 m."""
    elevation_deg: tuple[float, float] = (15.0, 90.0)
    """Elevation of the camera above the table, seen from the scene centre [deg]; lower views meet
    the table and hide objects behind each other."""
    seen_share: float = 0.85
    """Share of the keep-out volume that a view should have in its image; less is taken only where
    a direction offers nothing better. It rules out the nearest radii unless they are needed."""
    oversampling: int = 4
    """Directions tried per view wanted."""
    least_directions: int = 200
    """Directions tried at least, so that small plans see where the reachable set ends."""
    poses_per_direction: int = 24
    """Camera poses (roll and radius) tried per direction: free roll makes 94 % of the directions
    reachable, upright images only 70 %."""
    dense_poses: int = 36
    """Further poses tried in the directions that were chosen: the tour gets 6 % shorter."""
    board_distance_m: tuple[float, float] = (0.22, 0.40)
    """Camera to the board's aim point in calibration views [m]: varied, it separates the focal
    length from the distance."""
    board_tilt_deg: float = 45.0
    """Greatest angle between optical axis and board normal [deg]; tags blur beyond."""
    aim_jitter_m: float = 0.03
    """Aim points fill a square of this half-width on the board [m], so that the board moves over
    the whole image and the distortion is seen in the corners."""
    board_oversampling: int = 12
    """Poses tried per calibration view wanted."""
    table_height_m: float = 0.0
    """z of the table's top in base [m]."""
    table_rectangle_m: tuple[float, float, float, float] = (-0.6, 1.0, -0.8, 0.8)
    """x from, x to, y from, y to of the table in base [m]."""
    keep_out_m: tuple[float, float, float] = (0.30, 0.30, 0.12)
    """Size of the box on the table round the scene centre that only objects may fill [m]."""
    board_keep_out_m: tuple[float, float, float] = (0.30, 0.30, 0.02)
    """The same for a board that lies on the table [m]."""
    clearance_m: float = 0.010
    """Least distance to everything [m]: covers 1-5 mm of uncalibrated kinematics."""
    sigma_min: float = 0.05
    """Least singular value of the Jacobian [rad, m mixed]; below it, wrists spin near singular
    poses."""
    edge_step_rad: float = 0.04
    """Greatest joint step between checked configurations of a move [rad]: at most 37 mm at the
    stretched arm's tip, in practice 5 mm or less."""
    turn_reach_rad: float = 4.2
    """A joint may be this far from home [rad]: more than half a turn, so that a tour can pass the
    seam at pi, and little enough that cables do not wind up."""
    branch_limit: int = 200
    """Joint candidates kept per view, evenly taken from those in reach of home."""
    speed: float = 1.05
    """Speed of the leading joint [rad/s] (ur_rtde's moveJ default)."""
    acceleration: float = 1.4
    """Acceleration of the leading joint [rad/s^2] (ur_rtde's moveJ default)."""
    settle_s: float = 0.3
    """Waited at least at every view before the exposure [s]: a UR5 with a light camera rings for
    about 0.2 s after a stop."""
    closer_rounds: int = 5
    """Times that every view is offered the roll and radius that lie best between its neighbours in
    the tour; the gain of a round halves each time."""
    tour_steps: int = 3000
    """Steps of the tour's ruin and recreate: five times as many gain less than 1 %."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for name in ("radius_m", "elevation_deg", "board_distance_m"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise InputError(
                    f"{name.replace('_', ' ')}: ({low:g}, {high:g}) was given; the least and the "
                    "greatest are needed, in this order, both above 0."
                )
        if self.elevation_deg[1] <= LEAST_DEGREES:
            raise InputError(
                f"the elevations {self.elevation_deg} deg end {self.elevation_deg[1]:g} degrees "
                "above the table. Were radians given? Degrees are needed, such as 15,90."
            )
        if self.elevation_deg[1] > 90 or not 0 < self.board_tilt_deg < 90:
            raise InputError("PlanConfig: elevations and tilts lie between 0 and 90 degrees.")
        if self.radius_m[1] > 2.0 or self.board_distance_m[1] > 2.0:
            raise InputError(
                f"PlanConfig: radii {self.radius_m} and distances {self.board_distance_m} are in "
                "metres, farther than arms reach. Were millimetres given?"
            )
        if min(*self.keep_out_m, *self.board_keep_out_m) < 0:
            raise InputError("keep-out: the box of the objects has sizes of 0 or more [m].")
        if min(self.speed, self.acceleration, self.clearance_m, self.edge_step_rad) <= 0:
            raise InputError("PlanConfig: speed, acceleration, clearance, step must be positive.")

    def work_cell(
        self, center: ArrayLike, kind: str, obstacles: tuple[tuple[str, Box], ...] = ()
    ) -> WorkCell:
        """Return table, keep-out box and obstacles of a plan of this kind about center (3,) [m]."""
        x0, x1, y0, y1 = self.table_rectangle_m
        top = self.table_height_m
        size = self.keep_out_m if kind == "hemisphere" else self.board_keep_out_m
        x, y, _ = np.asarray(center, dtype=np.float64).tolist()
        table = Box(lower=(x0, y0, -np.inf), upper=(x1, y1, top))
        keep_out = Box(
            lower=(x - size[0] / 2, y - size[1] / 2, -np.inf),
            upper=(x + size[0] / 2, y + size[1] / 2, top + size[2]),
        )
        return WorkCell(table=table, keep_out=keep_out, obstacles=obstacles)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CapturePlan:
    """Views in the order in which they are taken, and how to get from each to the next.

    Move k ends at view k; it starts at view k-1, move 0 at `home`. Straight lines in joint space
    between home, the via points and the views have been checked for collision.
    """

    kind: Literal["hemisphere", "calibration", "imported"]
    chain: DhChain
    """The arm that the plan was made for, with its controller's calibration where it is known."""
    mount: Mount
    """The camera mount that the plan was made for."""
    cell: WorkCell
    """What the moves were checked against."""
    home: Array
    """(n,) where the tour begins [rad]."""
    joints: Array
    """(N, n) joints at each view [rad]."""
    center_world: Array
    """(3,) what the views look at [m]."""
    vias: tuple[tuple[int, Array], ...]
    """(move k, (K, n) joints to pass) of the moves that are not straight."""
    reference_view: int
    """The most top-down view."""
    config: PlanConfig
    metrics: dict[str, float] = field(default_factory=dict)
    """How good the plan is; the keys are explained in the stage's README."""
    Ts_base_ee: Array = field(init=False)
    """(N, 4, 4) flange at each view [m], by the chain."""
    Ts_base_cam: Array = field(init=False)
    """(N, 4, 4) camera at each view, if the mount is as nominal [m]."""

    def __post_init__(self) -> None:
        """Check shapes, place the flange and the camera, and freeze the arrays."""
        n = len(self.joints)
        q = self.chain.joints
        shapes = {"home": (q,), "joints": (n, q), "center_world": (3,)}
        for name, shape in shapes.items():
            array = frozen(getattr(self, name), np.float64, shape, f"the plan's {name}")
            if not np.all(np.isfinite(array)):
                raise InputError(f"the plan's {name} holds NaN or infinite numbers.")
            object.__setattr__(self, name, array)
        if n == 0 or not 0 <= self.reference_view < n:
            raise InputError(f"reference view {self.reference_view} is not one of {n} views.")
        vias: list[tuple[int, Array]] = []
        for k, via in self.vias:
            if not 0 <= k < n:
                raise InputError(f"via points of move {k}: the plan has the moves 0 to {n - 1}.")
            vias.append((k, frozen(via, np.float64, (None, q), f"via points of move {k}")))
        object.__setattr__(self, "vias", tuple(vias))
        Ts_base_ee = self.chain.forward(self.joints)
        for name, Ts in (
            ("Ts_base_ee", Ts_base_ee),
            ("Ts_base_cam", Ts_base_ee @ self.mount.T_ee_cam),
        ):
            Ts.setflags(write=False)
            object.__setattr__(self, name, Ts)

    @property
    def robot(self) -> str:
        """Name of the arm's model."""
        return self.chain.name

    @property
    def content_hash(self) -> str:
        """The sha256 of the plan's content, see `plan_content`."""
        return hash_of(plan_content(self))

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.joints)

    def move(self, k: int) -> Array:
        """Return the corners (K, n) of move k, its start and its view included [rad]."""
        start = self.home if k == 0 else self.joints[k - 1]
        via = [q for edge, q in self.vias if edge == k]
        return np.concatenate([start[None], *via, self.joints[k][None]])

    def collision_model(self) -> CollisionModel:
        """Return the model that the plan was checked with."""
        return CollisionModel(self.chain, self.mount, self.cell, self.config.clearance_m)

    def directions(self) -> Array:
        """Return the unit vectors (N, 3) from the centre to the cameras."""
        d = self.Ts_base_cam[:, :3, 3] - self.center_world
        return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True), dtype=np.float64)


def plan_content(plan: CapturePlan) -> dict[str, Any]:
    """Return what the plan is made of as plain JSON values; an infinite bound of a box is null.

    A change of these keys, or of the fields of `PlanConfig`, changes every hash: it needs a new
    schema version of the file.
    """
    dh = json_value(plan.chain)
    for name in ("T_base_0", "T_n_ee"):  # plans of arms that need none are as they always were
        if np.array_equal(getattr(plan.chain, name), np.eye(4)):
            del dh[name]
    names = (
        "mount", "cell", "home", "center_world", "reference_view", "joints", "vias", "config",
        "metrics",
    )  # fmt: skip
    return {
        "kind": plan.kind,
        "robot": dh.pop("name"),
        "limits": dh.pop("limits"),
        "dh": dh,
        **{name: json_value(getattr(plan, name)) for name in names},
    }


def segments(plan: CapturePlan) -> list[dict[str, Any]]:
    """Return all that a controller needs for each move, so that it needs nothing else.

    `corners` are the joints [rad] from the move's start over its via points to the view; the arm
    goes straight from one to the next in joint space and stops at each. `seconds` is the time of
    the motion, the settling that follows not included.
    """
    from realsim_capture_plans.planning.ordering import move_seconds

    c = plan.config
    rows: list[dict[str, Any]] = []
    for k in range(len(plan)):
        corners = plan.move(k)
        leading = np.abs(np.diff(corners, axis=0)).max(-1)
        rows.append(
            {
                "view": k,
                "seconds": round(float(np.sum(move_seconds(leading, c.speed, c.acceleration))), 6),
                "speed_rad_s": c.speed,
                "acceleration_rad_s2": c.acceleration,
                "settle_s": c.settle_s,
                "corners": corners.tolist(),
            }
        )
    return rows


def hash_of(content: dict[str, Any]) -> str:
    """Return the sha256 of a content."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _box_of(data: dict[str, Any]) -> Box:
    lower = [-np.inf if v is None else float(v) for v in data["lower"]]
    upper = [np.inf if v is None else float(v) for v in data["upper"]]
    return Box(lower=(lower[0], lower[1], lower[2]), upper=(upper[0], upper[1], upper[2]))


def plan_of(content: dict[str, Any]) -> CapturePlan:
    """Return the record of a plan's content."""
    config: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in content["config"].items()
    }
    mount, cell = content["mount"], content["cell"]
    mounted: dict[str, Any] = {**mount, "bracket": tuple(Shape(**s) for s in mount["bracket"])}
    return CapturePlan(
        kind=content["kind"],
        chain=DhChain(
            name=content["robot"], **content["dh"], limits=JointLimits(**content["limits"])
        ),
        mount=Mount(**mounted),
        cell=WorkCell(
            table=_box_of(cell["table"]),
            keep_out=_box_of(cell["keep_out"]),
            obstacles=tuple((str(name), _box_of(box)) for name, box in cell["obstacles"]),
        ),
        vias=tuple((int(k), np.array(q)) for k, q in content["vias"]),
        config=PlanConfig(**config),
        **{
            name: content[name]
            for name in ("home", "joints", "center_world", "reference_view", "metrics")
        },
    )
