"""What a grasp does when nothing is where it is thought to be: limit analysis on random draws.

A draw moves the object (by its registration's covariance and by the error of the robot cell that
will execute the grasp) and changes mass and pad stiffness. In each draw the hand comes as planned.
The approach ends where the palm meets the object. That is noted and fails nothing: of real trials
77 % held with it and 74 % without.

- blocked: an open finger reaches deeper into the object than it gives way.
- missed: a pad meets nothing.
- skewed: at this friction the squeeze alone cannot be balanced, the object is pushed out.
- overloaded: a stage's load is greater than what the contacts bear.

Friction and force are uncertain as well, and a draw's contacts tell all of them at once: friction
is one of a few levels alike, the force is uniform in a range, to which the factor is proportional.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import lru_cache

import numpy as np
from scipy.special import ndtri

from realsim.arrays import Array, Mask, Rows
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import STAGES, Mesh
from realsim.robots.hand import Hand, along_approach
from realsim_sim_bridge.grasping import surroundings
from realsim_sim_bridge.grasping.antipodal import RaySurface
from realsim_sim_bridge.grasping.limit_analysis import PadPatches, pad_patches, safety_factors
from realsim_sim_bridge.grasping.pad_contacts import pad_heights
from realsim_sim_bridge.slip.motion import Loads, stage_loads
from realsim_sim_bridge.slip.slip_test import SlipConfig, SlipTrial

PALM_M = 0.0015
"""So deep the palm may reach into the object before the hand has stopped [m]."""
WORST = 2
"""Loads of each stage, the worst at the nominal pose, that every draw is asked for."""
MOST_DRAWS = 4096
STEP_BACK_M, MOST_STEPS_BACK = 0.003, 20
"""A hand whose palm is in the object is moved back in such steps [m], at most so many."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseSpread:
    """Stated error of the robot cell that executes the grasp: standard deviations, table axes.

    The defaults are those of a cell whose object poses are a printed board's: where GRASPA's trials
    stop telling more spread from less (8 to 12 mm).
    """

    across_m: float = 0.008
    """Along the table's x and y, each [m]."""
    height_m: float = 0.003
    yaw_deg: float = 10.0
    """About the vertical through the object's centre of mass [deg]."""
    tilt_deg: float = 3.0
    """About x and y, each [deg]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class HoldConfig:
    """What p_hold depends on besides the hand, the objects and the stages' motion."""

    draws: int = 16
    """Draws of a grasp, 2 or more; a power of two is spread most evenly."""
    spread: PoseSpread = field(default_factory=PoseSpread)
    friction: tuple[float, ...] = (0.3, 0.45, 0.65, 1.0)
    """Coulomb coefficients, equally likely: rubber on waxed card and on dry wood."""
    force_share: tuple[float, float] = (2.0 / 7.0, 1.0)
    """The force on the object is uniform between these shares of the hand's: 20 to 70 N of 70."""
    mass_spread: float = 0.1
    """Standard deviation of the mass [share of it]."""
    stiffness_spread: float = 0.5
    """Standard deviation of the logarithm of how far pads give way."""
    conformity_m: float = 0.0015
    """What is so near to a pad that touches is touched too [m]: the object gives way as well, and
    scanned surfaces are off by as much. The pad's own share, force over stiffness, is added."""
    touch_m: float = 0.003
    """So far an open finger may reach into the object [m]: it slides off, or the object does."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InputError: one that cannot be; it is named with what can.
        """
        if not 2 <= self.draws <= MOST_DRAWS:
            raise InputError(
                f"p_hold needs 2 draws or more, for its error, and takes up to {MOST_DRAWS}; "
                f"{self.draws} were asked for. 16 are usual."
            )
        told = {f.name: getattr(self.spread, f.name) for f in fields(self.spread)}
        told |= {
            n: getattr(self, n)
            for n in ("mass_spread", "stiffness_spread", "conformity_m", "touch_m")
        }
        for name, value in told.items():
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"p_hold's {name} is {value}; 0 or more is accepted.")
        if not self.friction or not all(np.isfinite(mu) and mu > 0 for mu in self.friction):
            raise InputError(
                f"p_hold's friction is {self.friction}; positive numbers are accepted."
            )
        least, most = self.force_share
        if not 0 < least < most < np.inf:
            raise InputError(
                f"p_hold's force is {least:g} to {most:g} of the hand's; a range above 0 is needed."
            )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Drawn:
    """What N grasps did in K draws, before calibration."""

    holds: Array
    """(N, K) probability that the draw holds, over friction and force."""
    blocked: Array
    """(N,) shares of the draws, as in the head of this file; with those that hold they are 1."""
    missed: Array
    skewed: Array
    overloaded: Array
    palm: Array
    """(N,) share of draws in which the palm touches."""

    @property
    def share(self) -> Array:
        """(N,) share that holds."""
        return self.holds.mean(axis=1)

    @property
    def error(self) -> Array:
        """(N,) standard error of the share; of K draws that all say the same 1 / (K + 1)."""
        k = self.holds.shape[1]
        # As if one draw more had said the opposite: no finite number of draws proves 0 or 1.
        far = np.maximum(self.share, 1.0 - self.share)
        return np.sqrt((self.holds.var(axis=1) + far**2 / (k + 1)) / (k + 1))

    def measures(self) -> dict[str, Array]:
        """Return columns by the names of `realsim.records.grasps.MEASURES`."""
        names = ("blocked", "missed", "skewed", "overloaded", "palm")
        return {f"share_{name}": getattr(self, name) for name in names}


def chance_columns(
    mesh: Mesh,
    trial: SlipTrial,
    slip: SlipConfig,
    hand: Hand,
    config: HoldConfig,
    covariance: Array | None = None,
) -> dict[str, Array]:
    """Return the shares of the draws and the error of what holds, by names of MEASURES.

    The error is that of the share that holds; `p_hold_columns` makes p_hold and its error of them.

    Args:
        mesh: the object [m].
        trial: N grasps, one or more.
        slip: friction, force and stiffness of the nominal attempt, and the stages' motion.
        hand: the hand.
        config: what is uncertain.
        covariance: see `draw_holds`.

    Raises:
        InputError: the covariance is none.
    """
    physics, surface = slip.physics, GraspedObject.of(mesh)
    stiffness = physics.pads.pad_stiffness_n_per_m if physics.pads else np.inf
    loads = stage_loads(trial, slip.motion)
    drawn = draw_holds(
        surface, trial, loads, hand, physics.force_n, covariance, config, stiffness
    )  # fmt: skip
    return {"p_hold_error": drawn.error, **drawn.measures()}


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspedObject:
    """An object's surface, ready for rays and for hands that touch it."""

    rays: RaySurface
    tree: surroundings.SurfaceTree | None

    @classmethod
    def of(cls, mesh: Mesh) -> "GraspedObject":
        """Return the surface of a mesh."""
        return cls(rays=RaySurface(mesh), tree=surroundings.surface_tree(mesh.vertices[mesh.faces]))

    def stopped(self, Ts_obj_grasp: Array, hand: Hand, most_m: float) -> tuple[Array, Mask]:
        """Return where hands (N, 4, 4) stop that would reach into the object with the palm.

        Args:
            Ts_obj_grasp: (N, 4, 4) as planned [m].
            hand: the hand.
            most_m: so deep the palm may reach [m].

        Returns:
            the poses (N, 4, 4), moved back along the approach, and which were (N,).
        """
        palms = np.array(hand.palm_boxes)[None].repeat(len(Ts_obj_grasp), axis=0)
        back = np.zeros(len(Ts_obj_grasp))
        Ts = Ts_obj_grasp
        for _ in range(MOST_STEPS_BACK):
            inside = surroundings.first_triangle_inside(palms, Ts, self.tree, -most_m) >= 0
            if not inside.any():
                break
            back[inside] += STEP_BACK_M
            Ts = along_approach(Ts_obj_grasp, -back)
        return Ts, back > 0


def nominal_factors(
    obj: GraspedObject, trial: SlipTrial, loads: Loads, hand: Hand, friction: float, force_n: float,
    softness_m: float,
) -> Array:  # fmt: skip
    """Return the safety factors of all loads (N, L) where hands stop."""
    Ts, _ = obj.stopped(trial.Ts_obj_grasp, hand, PALM_M)
    pads = _pads(obj, trial, Ts, hand)
    patches = pad_patches(obj.rays, pads, trial.openings_m, hand, softness_m)
    n = len(trial)
    return safety_factors(
        patches, loads.about_grasp(_centers(trial, pads)), np.full(n, friction), np.full(n, force_n)
    )


def draw_holds(
    obj: GraspedObject,
    trial: SlipTrial,
    loads: Loads,
    hand: Hand,
    force_n: float,
    covariance: Array | None = None,
    config: HoldConfig | None = None,
    stiffness_n_per_m: float = np.inf,
) -> Drawn:
    """Return what the grasps do in all draws.

    Args:
        obj: the object's surface.
        trial: the grasps.
        loads: of the stages.
        hand: the hand.
        force_n: its usual force [N].
        covariance: (6, 6) of the object's registered pose, right perturbation, rotation first
            [rad, m]; None = of no registration.
        config: see `HoldConfig`.
        stiffness_n_per_m: of a pad.

    Raises:
        InputError: the covariance is none.
    """
    config = config or HoldConfig()
    count = config.draws
    normal = _normals(count, config.seed)
    Ts_moved = moved_objects(trial, covariance, config.spread, normal)
    mass = np.maximum(1.0 + config.mass_spread * normal[:, 12], 0.1)
    press_n = force_n * float(np.mean(config.force_share))
    soft = config.conformity_m + press_n / stiffness_n_per_m
    softness = soft * np.exp(config.stiffness_spread * normal[:, 13])
    low, high = (force_n * share for share in config.force_share)

    factors = nominal_factors(
        obj, trial, loads, hand, float(np.median(config.friction)), high, soft
    )
    at = _worst(factors, loads)
    palms = len(hand.palm_boxes)
    fingers = hand.boxes(trial.openings_m)[:, palms:]
    draws: list[tuple[Array | Mask, ...]] = []
    for k in range(count):
        Ts, touched = obj.stopped(Ts_moved[k], hand, PALM_M)
        blocked = surroundings.first_triangle_inside(fingers, Ts, obj.tree, -config.touch_m) >= 0
        pads = _pads(obj, trial, Ts, hand)
        patches = pad_patches(obj.rays, pads, trial.openings_m, hand, float(softness[k]))
        # The last load is none: it is borne wherever the squeeze is balanced.
        wrenches = np.pad(
            loads.about_grasp(_centers(trial, pads), at) * mass[k], ((0, 0), (0, 1), (0, 0))
        )
        holds, skewed = _borne(patches, wrenches, config.friction, low, high)
        free = ~blocked & patches.both
        draws.append((free * holds, blocked, ~blocked & ~patches.both, free * skewed, touched))
    held, *rare = (np.stack(column, axis=1) for column in zip(*draws, strict=True))
    blocked, missed, skewed, palm = (column.mean(axis=1) for column in rare)
    rest = 1.0 - held.mean(axis=1) - (blocked + missed + skewed)
    return Drawn(
        holds=held, blocked=blocked, missed=missed, skewed=skewed,
        overloaded=np.maximum(rest, 0.0), palm=palm,
    )  # fmt: skip


def _borne(
    patches: PadPatches, wrenches: Array, frictions: Sequence[float], low: float, high: float
) -> tuple[Array, Array]:
    """Return for grasps (N,) the shares of forces and frictions that bear all loads, and none.

    Args:
        patches: where the pads touch.
        wrenches: (N, L, 6) loads; the last is none.
        frictions: equally likely.
        low: least force on the object [N].
        high: greatest [N].
    """
    ones = np.ones(len(wrenches))
    holds, skewed = 0.0 * ones, 0.0 * ones
    for friction in frictions:
        borne = safety_factors(patches, wrenches, friction * ones, ones)
        with np.errstate(divide="ignore"):
            needed = 1.0 / borne.min(axis=1)
        holds += np.clip((high - needed) / (high - low), 0.0, 1.0)
        skewed += borne[:, -1] <= 0
    return holds / len(frictions), skewed / len(frictions)


def moved_objects(
    trial: SlipTrial, covariance: Array | None, spread: PoseSpread, normal: Array
) -> Array:
    """Return T_obj_grasp (K, N, 4, 4) of draws, with the object moved and the hand where it was.

    Args:
        trial: the grasps, one or more.
        covariance: see `draw_holds`.
        spread: of the robot cell.
        normal: (K, 12 or more) standard normal numbers: six of the cell, six of the registration.

    Raises:
        InputError: the covariance is not one.
    """
    root = np.zeros((6, 6)) if covariance is None else covariance_root(covariance)
    tilt, yaw = np.radians(spread.tilt_deg), np.radians(spread.yaw_deg)
    scale = np.array([tilt, tilt, yaw, spread.across_m, spread.across_m, spread.height_m])
    c = trial.body.center_of_mass
    # All grasps of an object share the object's own frame; the table's axes in it are any grasp's.
    R_obj_table = trial.Ts_obj_grasp[0, :3, :3] @ trial.Ts_table_grasp[0, :3, :3].T
    found: list[Array] = []
    for z in normal:
        cell = scale * z[:6]
        turn = R_obj_table @ se3.exp_so3(cell[:3]) @ R_obj_table.T
        moved = se3.from_rt(turn, c - turn @ c + R_obj_table @ cell[3:])
        moved = moved @ se3.exp(root @ z[6:12])
        found.append(se3.invert(moved) @ trial.Ts_obj_grasp)
    return np.stack(found)


def covariance_root(covariance: Array) -> Array:
    """Return a root (6, 6) of a covariance (6, 6).

    Raises:
        InputError: it is not symmetric or has a negative variance.
    """
    C = np.asarray(covariance, dtype=np.float64)
    if C.shape != (6, 6) or not np.isfinite(C).all() or not np.allclose(C, C.T, atol=1e-12):
        raise InputError(
            "the covariance of an object's pose must be (6, 6), symmetric and finite; found "
            f"{C.shape}. Register the scene again, or leave it out."
        )
    values, axes = np.linalg.eigh(C)
    if values[0] < -1e-9 * max(values[-1], 1e-12):
        raise InputError(
            f"the covariance of an object's pose has the negative variance {values[0]:.3g}; it "
            "must be positive. Register the scene again, or leave it out."
        )
    return axes * np.sqrt(np.maximum(values, 0.0))


@lru_cache(maxsize=4)
def _normals(count: int, seed: int) -> Array:
    """Return standard normal numbers (K, 14), spread evenly (Sobol), the same for every object."""
    from scipy.stats import qmc  # takes longer to load than all else here

    sobol = qmc.Sobol(14, scramble=True, rng=np.random.default_rng(seed))
    uniform = sobol.random_base2(int(np.ceil(np.log2(count))))[:count]
    return np.asarray(ndtri(np.clip(uniform, 1e-9, 1.0 - 1e-9)))


def _worst(factors: Array, loads: Loads) -> Rows:
    """Return the numbers (N, l) of the worst loads of each stage but the rest."""
    chosen: list[Rows] = []
    size = np.linalg.norm(loads.wrenches[..., 3:], axis=-1)
    for k in range(1, len(STAGES)):
        rows = np.flatnonzero(loads.stage == k)
        # Of loads that are not borne at all the greatest force comes first.
        order = np.lexsort((-size[:, rows], factors[:, rows]))
        chosen.append(rows[order[:, :WORST]])
    return np.concatenate(chosen, axis=1)


def _pads(obj: GraspedObject, trial: SlipTrial, Ts_obj_grasp: Array, hand: Hand) -> Array:
    """Return T_obj_pads (N, 4, 4) of hands that have closed."""
    if not hand.arc_radius_m:
        return Ts_obj_grasp
    heights = pad_heights(obj.rays, Ts_obj_grasp, trial.openings_m, hand)
    return along_approach(Ts_obj_grasp, heights)


def _centers(trial: SlipTrial, Ts_obj_pads: Array) -> Array:
    """Return the centre of mass between the pads (N, 3) [m]."""
    return se3.transform(se3.invert(Ts_obj_pads), trial.body.center_of_mass[None])[:, 0]
