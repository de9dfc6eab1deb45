"""Does the Panda reach a grasp: inverse kinematics, straight approach, lift, and the way there.

The arm hangs above the table, its base tilted by 90 degrees (the paper's "perfect reach"). For each
candidate the closed-form solutions at the grasp are followed back along the approach and up along
the table's normal without changing branch; the first whose moves are free and that can be reached
from home is kept.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.geometry import se3
from realsim_sim_bridge.arm import panda
from realsim_sim_bridge.arm.arm_space import (
    AT_LIMITS,
    FREE,
    IN_TABLE,
    ArmSpace,
    ArmSpaceConfig,
    Codes,
    in_words,
)
from realsim_sim_bridge.grasping.candidates import Surroundings
from realsim_sim_bridge.grasping.hand import HandGeometry
from realsim_sim_bridge.grasping.hand_free import first_point_inside, lowest_corner
from realsim_sim_bridge.arm.joint_path import PlannerConfig, connect, straight

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class ReachConfig:
    """Where the arm stands and which moves it must be able to make."""

    base_height_m: float = 0.70
    """Height of the base over the table [m]. With the next among the best of a grid: 89 %
    of random grasps within 60 deg of straight down on 36 x 36 cm are reached and lifted."""
    base_back_m: float = 0.60
    """Distance of the base from the middle of the scene, against its own tilted z axis [m]; nearer
    than 0.4 m joint 5 cannot turn the hand straight down."""
    home_height_m: float = 0.30
    """Height of the hand over the table, above the middle of the scene, before each grasp [m]."""
    approach_m: float = 0.08
    """Length of the straight approach [m]: a finger and a half."""
    lift_m: float = 0.20
    """Height that the arm must be able to lift straight up [m]; the slip test's."""
    step_m: float = 0.02
    """Distance between checked poses of the straight moves [m]."""
    joint7_samples: int = 12
    """Values of joint 7 tried at each grasp."""
    branches: int = 6
    """Free solutions per grasp that are followed."""
    limit_margin_rad: float = 0.02
    """Distance kept from the joint limits [rad]."""
    space: ArmSpaceConfig = field(default_factory=ArmSpaceConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    hand_clearance_m: float = 0.001
    """Least distance of the hand's boxes from objects during approach and lift [m]; at the grasp
    the candidates' own, larger ones hold."""
    tolerance: float = 1e-6
    """Largest error of a followed pose [m, rad]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Reach:
    """Which candidates the arm can take."""

    reachable: NDArray[np.bool_]
    """(N,) whether there is a collision-free trajectory to closure."""
    joints: Array
    """(N, 7) joint angles at the grasp [rad]; NaN where there are none."""
    joints_lifted: Array
    """(N, 7) after the lift [rad]; NaN likewise."""
    reasons: tuple[str, ...]
    """(N,) why not; '' = reachable."""
    planned: int
    """How many needed more than the straight move from home."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ReachTask:
    """The grasps of one object among its neighbours, in the table's frame."""

    Ts_table_grasp: Array
    """(N, 4, 4) [m]."""
    widths_m: Array
    """(N,) [m]."""
    openings_m: Array
    """(N,) [m]."""
    obj: Surroundings
    """Points on the grasped object."""
    neighbours: Surroundings
    """Points on the others."""
    middle_xy: tuple[float, float]
    """Middle of the scene on the table [m]: the arm's base is placed by it."""


def base_on_table(middle_xy: tuple[float, float], config: ReachConfig) -> Array:
    """Return T_table_base (4, 4): above the table, z along the table's x, x straight down."""
    R = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    at = [middle_xy[0] - config.base_back_m, middle_xy[1], config.base_height_m]
    return se3.from_rt(R, at)


def home_joints(config: ReachConfig) -> Array:
    """Return the joints (7,) [rad] with the hand pointing down above the middle of the scene.

    Raises:
        InputError: the arm's base is placed so that it cannot.
    """
    down = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    T_table_grasp = se3.from_rt(down, [0.0, 0.0, config.home_height_m])
    T_base_grasp = se3.invert(base_on_table((0.0, 0.0), config)) @ T_table_grasp
    q = panda.inverse(T_base_grasp, config.joint7_samples, config.limit_margin_rad)
    if len(q) == 0:
        raise InputError(
            f"the arm cannot hold its hand {config.home_height_m} m over the table from a base "
            f"{config.base_height_m} m high and {config.base_back_m} m back; choose another base."
        )
    middle = (panda.LOWER + panda.UPPER) / 2
    return q[np.argmin(np.linalg.norm((q - middle) / (panda.UPPER - panda.LOWER), axis=1))]


def check_reach(
    task: ReachTask, config: ReachConfig, geometry: HandGeometry, rng: np.random.Generator
) -> Reach:
    """Return which grasps have a collision-free trajectory to closure and lift.

    Args:
        task: the grasps and what is around them.
        config: the arm's place and moves.
        geometry: the hand.
        rng: chance for the planner alone.
    """
    return _ReachCheck(task, config, geometry).run(rng)


class _ReachCheck:
    """The check of one object's grasps; `branch` rows are (grasp, solution) pairs."""

    def __init__(self, task: ReachTask, config: ReachConfig, geometry: HandGeometry) -> None:
        self._task, self._config, self._geometry = task, config, geometry
        self._T_table_base = base_on_table(task.middle_xy, config)
        obstacles = Surroundings(
            points=np.concatenate([task.obj.points, task.neighbours.points]),
            instances=np.concatenate([task.obj.instances, task.neighbours.instances]),
        )
        self._space = ArmSpace(self._T_table_base, obstacles, config.space)
        self._home = home_joints(config)
        n = len(task.Ts_table_grasp)
        self._reasons = ["no inverse kinematics at the grasp"] * n
        self._joints = np.full((n, panda.JOINTS), np.nan)
        self._lifted = np.full((n, panda.JOINTS), np.nan)
        self._planned = 0

    def run(self, rng: np.random.Generator) -> Reach:
        """Go through the moves; each step keeps the branches that are still free."""
        owner, q = self._solutions()
        codes = self._space.blame(panda.link_frames(q), with_hand=False)
        rows = self._free(owner, codes, "the arm at the grasp")
        rows = rows[self._nearest_home(owner[rows], q[rows])]
        owner, q = owner[rows], q[rows]
        back, up = self._moves()
        approach, codes = self._follow(q, back[owner])
        codes = _first(self._hand_on_approach(back)[owner], codes)
        rows = self._free(owner, codes, "the approach")
        owner, q, approach = owner[rows], q[rows], approach[rows]
        lift, codes = self._follow(q, up[owner])
        codes = _first(self._hand_on_lift(up)[owner], codes)
        rows = self._free(owner, codes, "the lift")
        self._reach_from_home(owner[rows], q[rows], approach[rows, -1], lift[rows, -1], rng)
        reachable = ~np.isnan(self._joints[:, 0])
        return Reach(
            reachable=reachable,
            joints=self._joints,
            joints_lifted=self._lifted,
            reasons=tuple(
                "" if ok else why for ok, why in zip(reachable, self._reasons, strict=True)
            ),
            planned=self._planned,
        )

    # --- branches ------------------------------------------------------------------------------

    def _solutions(self) -> tuple[Codes, Array]:
        """Return all solutions at the grasps: owner (B,) and joints (B, 7)."""
        config = self._config
        Ts = se3.invert(self._T_table_base) @ self._task.Ts_table_grasp
        found = [panda.inverse(T, config.joint7_samples, config.limit_margin_rad) for T in Ts]
        owner = np.repeat(np.arange(len(found)), [len(q) for q in found])
        return owner, np.concatenate([np.zeros((0, panda.JOINTS)), *found])

    def _free(self, owner: Codes, codes: Codes, move: str) -> Codes:
        """Return the rows of the free branches, and note why grasps without one have none."""
        free = codes == FREE
        alive = set(owner[free].tolist())
        for grasp, code in zip(owner[~free].tolist(), codes[~free].tolist(), strict=True):
            if grasp not in alive:
                self._reasons[grasp] = f"{move} {in_words(code)}"
        return np.nonzero(free)[0]

    def _nearest_home(self, owner: Codes, q: Array) -> Codes:
        """Return the rows of at most `branches` solutions of each grasp, the nearest home first."""
        distance = np.linalg.norm(q - self._home, axis=1)
        order = np.lexsort((distance, owner))
        owner = owner[order]
        rank = np.arange(len(owner)) - np.searchsorted(owner, owner)
        return order[rank < self._config.branches]

    # --- straight moves ------------------------------------------------------------------------

    def _moves(self) -> tuple[Array, Array]:
        """Return T_table_grasp backwards from the grasp, and up from above it (N, W, 4, 4)."""
        Ts, config = self._task.Ts_table_grasp, self._config
        back = np.linspace(0, 1, round(config.approach_m / config.step_m) + 1)
        up = np.linspace(0, 1, round(config.lift_m / config.step_m) + 1)[1:]
        approach, lift = np.repeat(Ts[:, None], len(back), 1), np.repeat(Ts[:, None], len(up), 1)
        approach[..., :3, 3] -= config.approach_m * back[:, None] * Ts[:, None, :3, 2]
        lift[..., 2, 3] += config.lift_m * up
        return approach, lift

    def _follow(self, q: Array, Ts_table_grasp: Array) -> tuple[Array, Codes]:
        """Follow poses (B, W, 4, 4) from q (B, 7) without changing branch.

        Returns:
            joints (B, W, 7) and what stops each branch (B,).
        """
        Ts = se3.invert(self._T_table_base) @ Ts_table_grasp
        path = np.empty((*Ts.shape[:2], panda.JOINTS))
        ok = np.ones(len(q), dtype=np.bool_)
        for w in range(Ts.shape[1]):
            q, error = _towards(q, Ts[:, w])
            path[:, w] = q
            ok &= error < self._config.tolerance
            ok &= panda.within_limits(q, self._config.limit_margin_rad)
        codes = _worst(self._space.blame(panda.link_frames(path), with_hand=False))
        return path, np.where(ok, codes, AT_LIMITS)

    def _hand_on_approach(self, back: Array) -> Codes:
        """Return what the open hand meets on each grasp's approach (N,)."""
        boxes = self._geometry.boxes(self._task.openings_m)
        return self._hand_blame(boxes, back, (self._task.neighbours, self._task.obj))

    def _hand_on_lift(self, up: Array) -> Codes:
        """Return what the closed hand meets on each grasp's lift (N,); the object rises with it."""
        boxes = self._geometry.boxes(self._task.widths_m)
        return self._hand_blame(boxes, up, (self._task.neighbours,))

    def _hand_blame(
        self, boxes: Array, Ts_table_grasp: Array, obstacles: tuple[Surroundings, ...]
    ) -> Codes:
        """Return what the hand's boxes (N, 3, 2, 3) meet on poses (N, W, 4, 4)."""
        codes = np.full(len(boxes), FREE, dtype=np.int64)
        for w in range(Ts_table_grasp.shape[1]):
            Ts = Ts_table_grasp[:, w]
            below = np.where(lowest_corner(boxes, Ts) < 0, IN_TABLE, FREE)
            codes = _first(codes, below)
            for things in obstacles:
                point = first_point_inside(boxes, Ts, things.points, self._config.hand_clearance_m)
                hit = point >= 0
                codes[hit] = _first(codes[hit], things.instances[point[hit]])
        return codes

    # --- the way there ---------------------------------------------------------------------------

    def _reach_from_home(
        self, owner: Codes, q: Array, before: Array, after: Array, rng: np.random.Generator
    ) -> None:
        """Keep of each grasp the first branch whose pre-grasp `before` is reached from home."""
        step = self._config.planner.resolution_rad
        paths = [straight(self._home, goal, step) for goal in before]
        counts = np.array([len(path) for path in paths], dtype=np.int64)
        row = np.repeat(np.arange(len(paths)), counts)
        free = self._is_free(np.concatenate([np.zeros((0, panda.JOINTS)), *paths]))
        blocked = np.bincount(row[~free], minlength=len(paths)) > 0
        goals_free = self._is_free(before)
        for grasp in np.unique(owner).tolist():
            branches = np.nonzero(owner == grasp)[0]
            direct = branches[~blocked[branches]]
            # Branches come nearest to home first; only free pre-grasps are worth a plan.
            chosen = (
                direct[0]
                if len(direct)
                else self._plan(before, branches[goals_free[branches]], rng)
            )
            if chosen is None:
                self._reasons[grasp] = "no path from home"
                continue
            self._joints[grasp], self._lifted[grasp] = q[chosen], after[chosen]

    def _plan(self, before: Array, branches: Codes, rng: np.random.Generator) -> int | None:
        """Return the first of the branches with a path from home, or None; the first is tried."""
        for branch in branches[:1].tolist():
            path = connect(self._home, before[branch], self._is_free, self._config.planner, rng)
            if path is not None:
                self._planned += 1
                return branch
        return None

    def _is_free(self, q: Array) -> NDArray[np.bool_]:
        """Return whether arm and hand are free at joints (M, 7)."""
        return self._space.blame(panda.link_frames(q), with_hand=True) == FREE


NEWTON_STEPS = 4
"""Newton steps per followed pose: 2 cm apart, the error is below 1e-9 after three."""
DAMPING = 1e-10
"""Keeps the step finite at a singularity, where the error then stays large."""


def _towards(q: Array, Ts_base_grasp: Array) -> tuple[Array, Array]:
    """Return joints (B, 7) that move least from q to reach the poses, and the error left (B,)."""
    error = np.zeros(len(q))
    for step in range(NEWTON_STEPS + 1):
        frames = panda.link_frames(q)
        T = frames[..., -1, :, :]
        turn = se3.log_so3(Ts_base_grasp[:, :3, :3] @ np.swapaxes(T[:, :3, :3], -1, -2))
        gap = np.concatenate([turn, Ts_base_grasp[:, :3, 3] - T[:, :3, 3]], axis=1)
        error = np.linalg.norm(gap, axis=1)
        if step == NEWTON_STEPS:
            break
        J = panda.jacobian(frames)
        square = J @ np.swapaxes(J, -1, -2) + DAMPING * np.eye(6)
        change = (np.swapaxes(J, -1, -2) @ np.linalg.solve(square, gap[..., None]))[..., 0]
        # Far steps happen only near singularities, and they change the branch.
        q = q + np.clip(change, -0.5, 0.5)
    return q, error


def _first(codes: Codes, others: Codes) -> Codes:
    """Return `codes`, and `others` where those are free."""
    return np.where(codes == FREE, others, codes)


def _worst(codes: Codes) -> Codes:
    """Return the first code of each row (B, W) that is not free, or FREE."""
    if codes.shape[1] == 0:
        return np.full(len(codes), FREE, dtype=np.int64)
    stopped = codes != FREE
    return np.where(
        stopped.any(axis=1), codes[np.arange(len(codes)), np.argmax(stopped, axis=1)], FREE
    )
