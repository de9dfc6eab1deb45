"""The load at which a held cube slips or turns, against Coulomb's limit; and no creep below it."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from realsim.arrays import Array, Mask
from realsim_sim_bridge.slip.slip_test import SlipConfig
from realsim_sim_bridge.slip.world import Engine, PadModel
from realsim_sim_bridge.validation.config import ValidationConfig
from realsim_sim_bridge.validation.loads import LOST_M, Held, hand_patch, hold, with_hand
from realsim_sim_bridge.validation.report import CheckResult, LimitRatio
from realsim_sim_bridge.validation.specimens import DOWN, cube, cube_trial, specimen


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlanarLoad:
    """A load in the plane of the pads, of unit size."""

    name: str
    turning: float
    """Torque about the plane's normal, from x to z [m for a force, 1 for a pure torque]."""
    force: Array
    """(2,) along x and z; zero for a pure torque."""

    def planar(self) -> Array:
        """Return the load (3,) as `FrictionPatch` takes it."""
        return np.array([self.turning, *self.force])

    def wrench(self) -> Array:
        """Return the load (6,) in grasp axes: from x to z is a negative turn about y."""
        return np.array([0.0, -self.turning, 0.0, self.force[0], 0.0, self.force[1]])


def pulls(directions_deg: tuple[float, ...]) -> list[PlanarLoad]:
    """Return straight pulls through the centre, at angles from x to z [deg]."""
    angles = np.radians(directions_deg)
    return [
        PlanarLoad(
            name=_AXES.get(d % 360.0, f"{d:g} deg"),
            turning=0.0,
            force=np.array([np.cos(a), np.sin(a)]),
        )
        for d, a in zip(directions_deg, angles.tolist(), strict=True)
    ]


def turns(arms_m: tuple[float, ...]) -> list[PlanarLoad]:
    """Return pure torques both ways, and forces that pull beside the centre.

    A force f at r turns by r_x f_z - r_z f_x: -z at an arm along x, x at an arm along z.
    """
    none = np.zeros(2)
    loads = [
        PlanarLoad(name="spin", turning=1.0, force=none),
        PlanarLoad(name="spin back", turning=-1.0, force=none),
    ]
    for arm in arms_m:
        off = f"{1e3 * arm:g} mm off"
        loads += [
            PlanarLoad(name=f"-z, {off}", turning=-arm, force=np.array([0.0, -1.0])),
            PlanarLoad(name=f"x, {off}", turning=-arm, force=np.array([1.0, 0.0])),
        ]
    return loads


_AXES = {0.0: "x", 90.0: "z", 180.0: "-x", 270.0: "-z"}


def limit_checks(
    engine: Engine, config: ValidationConfig, group: Literal["coulomb", "torque"]
) -> tuple[list[CheckResult], list[LimitRatio]]:
    """Return the error of the limits of a group of loads, the worst of all forces.

    "coulomb" is the limit 2 mu F in every direction; "torque" are spin and off-centre loads.
    """
    limits = config.limits
    if group == "coulomb":
        loads, cases, shares = pulls(limits.directions_deg), limits.cases, limits.coulomb_shares
        what = "error of the pull at which the cube slips, against 2 mu F"
        limit_pct = limits.coulomb_pct
    else:
        loads, cases, shares = turns(limits.arms_m), limits.torque_cases, limits.torque_shares
        what = "error of the load that turns the cube, against the pads' limit surface"
        limit_pct = limits.torque_pct
    ratios = [_ratio(engine, config, group, load, case, shares) for case in cases for load in loads]
    return list(_by_load(ratios, what, limit_pct)), ratios


def creep_checks(engine: Engine, config: ValidationConfig) -> list[CheckResult]:
    """Return how far a cube moves in a long hold below the limit."""
    limits = config.limits
    loads = [*pulls(limits.directions_deg), *turns(limits.arms_m)]
    worst_m, worst_rad, where = 0.0, 0.0, ""
    for force_n, friction in limits.torque_cases:
        slip = with_hand(config.slip, force_n, friction)
        sizes = [_limit(load, slip) for load in loads]
        wrenches = [
            limits.creep_share * size * load.wrench()
            for size, load in zip(sizes, loads, strict=True)
        ]
        held = _held_cube(engine, config, slip, np.stack(wrenches), limits.creep_s)
        k = int(np.argmax(held.creep_m))
        if held.creep_m[k] >= worst_m:
            worst_m, where = float(held.creep_m[k]), f"{_case(slip)}, {loads[k].name}"
        worst_rad = max(worst_rad, float(held.creep_rad.max()))
    share = f"{limits.creep_s:g} s at {100 * limits.creep_share:g} % of the limit"
    return [
        CheckResult(
            group="creep", name="no creep", what=f"motion of the held cube in {share}",
            measured=1e3 * worst_m, unit="mm", limit=1e3 * limits.creep_m,
            detail=f"{share}; worst at {where}",
        ),
        CheckResult(
            group="creep", name="no creeping turn", what=f"turn of the held cube in {share}",
            measured=float(np.degrees(worst_rad)), unit="deg", limit=limits.creep_deg,
            detail=f"{share}, {len(loads)} loads",
        ),
    ]  # fmt: skip


def curved_check(engine: Engine, config: ValidationConfig) -> CheckResult:
    """Return how far an upright cylinder creeps under half of what its contacts carry along it.

    Where a sphere meets a curved face its normal leans; along the cylinder all of them carry
    2 mu F or more, whichever they are.
    """
    limits = config.limits
    worst, where = 0.0, ""
    pulled = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, sign] for sign in (-1.0, 1.0)])
    for force_n, friction in limits.torque_cases:
        slip = with_hand(config.slip, force_n, friction)
        load = limits.curved_share * 2.0 * friction * force_n
        held = hold(
            engine,
            slip,
            config.hand,
            specimen("cylinder", _mass(config, slip)),
            load * pulled,
            ramp_s=limits.ramp_s,
            hold_s=limits.creep_s,
        )
        creep = float(held.creep_m.max())
        if creep >= worst:
            worst, where = creep, _case(slip)
    return CheckResult(
        group="creep",
        name="no creep on a cylinder",
        what="motion of the held cylinder along its axis",
        measured=1e3 * worst,
        unit="mm",
        limit=1e3 * limits.creep_m,
        detail=f"{limits.creep_s:g} s at {limits.curved_share:g} of 2 mu F; worst at {where}",
    )


def force_check(engine: Engine, config: ValidationConfig) -> CheckResult:
    """Return the error of the fingers' measured force on a closed, unloaded cube."""
    worst, seen = 0.0, ""
    for force_n, friction in config.limits.cases:
        slip = with_hand(config.slip, force_n, friction)
        held = hold(
            engine,
            slip,
            config.hand,
            cube(_mass(config, slip)),
            np.zeros((1, 6)),
            ramp_s=0.05,
            hold_s=0.05,
        )
        error = float(100 * np.abs(held.finger_n / force_n - 1.0).max())
        seen += f"{', ' if seen else ''}{held.finger_n.min():.4g} of {force_n:g} N"
        worst = max(worst, error) if np.isfinite(error) else float("nan")
    return CheckResult(
        group="settings", name="finger force", what="error of the fingers' measured normal force",
        measured=worst, unit="%", limit=config.stages.force_pct, detail=seen,
    )  # fmt: skip


def press_checks(engine: Engine, config: ValidationConfig) -> list[CheckResult]:
    """Return the error of the pads' stiffness, measured by pressing the cube with two forces."""
    if config.slip.physics.pads is None:
        return []
    asked = config.slip.physics.pads.pad_stiffness_n_per_m
    trial = cube_trial(_mass(config, config.slip), DOWN[None], config.hand)
    forces = np.array([0.5, 1.0]) * config.slip.physics.force_n
    grips = trial.grips(config.slip.headroom_m)
    faces_m = np.zeros(2)
    for i, force_n in enumerate(forces.tolist()):
        slip = with_hand(config.slip, force_n, config.slip.physics.friction)
        with engine.world(trial.met(slip.physics, config.hand), grips) as world:
            world.close(slip.closing)
            still = max(1, round(config.limits.hold_s / world.dt))
            world.play(np.zeros((1, still, 6)), still, LOST_M)
            faces_m[i] = world.states().fingers_m.mean()
    with np.errstate(divide="ignore"):
        found = float((forces[1] - forces[0]) / (faces_m[0] - faces_m[1]))
    return [
        CheckResult(
            group="settings", name="pad stiffness", what="error of the pads' measured stiffness",
            measured=100.0 * abs(found / asked - 1.0), unit="%", limit=config.stages.stiffness_pct,
            detail=f"{found:.4g} of {asked:.4g} N/m, {forces[0]:g} to {forces[1]:g} N",
        )
    ]  # fmt: skip


def bracket(shares: Array, slipped: Mask) -> tuple[float, float]:
    """Return the largest share below which all were held, and the smallest above which all slipped.

    Args:
        shares: (S,) ascending loads in units of the limit.
        slipped: (S,) whether the cube did under each.
    """
    below = np.cumsum(slipped) == 0
    above = np.cumsum(~slipped[::-1])[::-1] == 0
    held = float(shares[below].max()) if below.any() else 0.0
    return held, float(shares[above].min()) if above.any() else float("inf")


def _ratio(
    engine: Engine,
    config: ValidationConfig,
    group: str,
    load: PlanarLoad,
    case: tuple[float, float],
    shares: tuple[float, ...],
) -> LimitRatio:
    """Return between which loads the cube begins to slip, in units of the computed limit."""
    slip = with_hand(config.slip, *case)
    ascending = np.sort(np.array(shares))
    wrenches = ascending[:, None] * _limit(load, slip) * load.wrench()
    held = _held_cube(engine, config, slip, wrenches, config.limits.hold_s)
    low, high = bracket(ascending, _slipped(held, config))
    return LimitRatio(group=group, load=load.name, case=_case(slip), held=low, slipped=high)


def _held_cube(
    engine: Engine, config: ValidationConfig, slip: SlipConfig, loads: Array, hold_s: float
) -> Held:
    """Return what cubes do under loads (K, 6) that grow as the suite's do and then stand."""
    body, ramp_s = cube(_mass(config, slip)), config.limits.ramp_s
    return hold(engine, slip, config.hand, body, loads, ramp_s=ramp_s, hold_s=hold_s)


def _slipped(held: Held, config: ValidationConfig) -> Mask:
    """Return whether each cube moved or turned further than a held one may (K,)."""
    limits = config.limits
    return (held.shift_m > limits.held_m) | (held.turn_rad > np.radians(limits.held_deg))


def _limit(load: PlanarLoad, slip: SlipConfig) -> float:
    """Return how many units of the load two fingers carry; bare boxes are judged like pads."""
    physics = slip.physics
    points = (physics.pads or PadModel()).centers_xz()
    return hand_patch(points, physics.force_n, physics.friction).slip_load(load.planar())


def _mass(config: ValidationConfig, slip: SlipConfig) -> float:
    """Return the mass that goes with what is carried [kg]."""
    physics, limits = slip.physics, config.limits
    carried = 2.0 * physics.friction * physics.force_n / limits.limit_acceleration
    return float(np.clip(carried, *limits.masses_kg))


def _case(slip: SlipConfig) -> str:
    """Return force and friction in words."""
    return f"{slip.physics.force_n:g} N, mu {slip.physics.friction:g}"


def _by_load(ratios: list[LimitRatio], what: str, limit_pct: float) -> Iterator[CheckResult]:
    """Yield one check a load: the worst of its cases."""
    for load in dict.fromkeys(r.load for r in ratios):
        mine = [r for r in ratios if r.load == load]
        worst = max(mine, key=lambda r: r.error)
        yield CheckResult(
            group=worst.group,
            name=f"{worst.group} limit, {load}",
            what=what,
            # Rounded, because 0.97 is not 3 % below 1 in binary.
            measured=round(100.0 * worst.error, 6),
            unit="%",
            limit=limit_pct,
            detail=f"holds {worst.held:g}, slips {worst.slipped:g} at {worst.case}; "
            f"{len(mine)} cases",
        )
