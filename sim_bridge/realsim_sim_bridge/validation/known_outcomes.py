"""Grasps through all four stages whose outcome is known: the symmetric box, and too weak a hand."""

from collections.abc import Iterator

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim_sim_bridge.slip.motion import SlipMotion, lift_acceleration, oscillation_acceleration
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import run_slip_test
from realsim_sim_bridge.slip.world import Engine, PadModel
from realsim_sim_bridge.validation.config import ValidationConfig
from realsim_sim_bridge.validation.loads import with_hand
from realsim_sim_bridge.validation.report import CheckResult
from realsim_sim_bridge.validation.specimens import DOWN, SIDE_M, cube_trial


def box_checks(engine: Engine, config: ValidationConfig) -> Iterator[CheckResult]:
    """Yield score, slip and turn of the plain cube, held from above, from the side and askew."""
    stages = config.stages
    for mass in stages.box_masses_kg:
        slips = run_slip_test(
            cube_trial(mass, _approaches(), config.hand),
            config.slip,
            geometry=config.hand,
            engine=engine,
        )
        least_score = float(slips.scores(ScoreLimits())[1].min())
        label = f"{1e3 * mass:g} g"
        size = f"{label} cube of 5 cm, {config.slip.physics.force_n:g} N"
        failed = "; ".join(dict.fromkeys(f for f in slips.failures if f))
        with np.errstate(invalid="ignore"):
            slip_mm = np.nan_to_num(1e3 * slips.slip_m, nan=np.inf, posinf=np.inf).max(axis=0)
            turn_deg = np.nan_to_num(np.degrees(slips.slip_rad), nan=np.inf, posinf=np.inf).max(
                axis=0
            )
        yield from (
            CheckResult(
                group="box", name=f"box {label}, score", what=f"least score of the {size}",
                measured=least_score, unit="", limit=1.0, at_least=True,
                detail=failed or f"{len(slips.failures)} approaches",
            ),
            CheckResult(
                group="box", name=f"box {label}, slip", what=f"slip of the {size} in a stage",
                measured=float(slip_mm.max()), unit="mm",
                limit=1e3 * (stages.box_slip_m + _arc_m(config)),
                detail=_per_stage(slip_mm),
            ),
            CheckResult(
                group="box", name=f"box {label}, turn", what=f"turn of the {size} in a stage",
                measured=float(turn_deg.max()), unit="deg", limit=stages.box_turn_deg,
                detail=_per_stage(turn_deg),
            ),
        )  # fmt: skip


def _arc_m(config: ValidationConfig) -> float:
    """Return how far pads on an arc rise while the force presses them into the cube [m]."""
    pads = config.slip.physics.pads or PadModel()
    give = config.slip.physics.force_n / pads.pad_stiffness_n_per_m
    return float(abs(config.hand.slope(SIDE_M / 2))) * give


def capacity_checks(engine: Engine, config: ValidationConfig) -> list[CheckResult]:
    """Return whether hands below the load drop the cube and hands above it hold it.

    What friction carries is 2 mu F, whatever mu and F are; the load is the mass times the greatest
    acceleration that lift and oscillation ask for.
    """
    stages = config.stages
    mass = stages.capacity_mass_kg
    weight = mass * config.slip.motion.gravity
    peak = peak_load(mass, config.slip.motion)
    weak = [_carry(engine, config, case) for case in stages.fails]
    strong = [_carry(engine, config, case) for case in stages.holds]
    dropped = [f.startswith("lift") and c < weight for f, c, _ in weak]
    held = [f == "" and c > peak for f, c, _ in strong]
    return [
        CheckResult(
            group="capacity", name="capacity below the weight",
            what="share of too weak hands that drop the cube in the lift",
            measured=float(np.mean(dropped)), unit="", limit=1.0, at_least=True,
            detail=f"weight {weight:.2f} N; " + "; ".join(d for _, _, d in weak),
        ),
        CheckResult(
            group="capacity", name="capacity above the load",
            what="share of strong enough hands that hold the cube to the end",
            measured=float(np.mean(held)), unit="", limit=1.0, at_least=True,
            detail=f"peak load {peak:.2f} N; " + "; ".join(d for _, _, d in strong),
        ),
    ]  # fmt: skip


def peak_load(mass_kg: float, motion: SlipMotion) -> float:
    """Return the greatest force that lift and oscillation ask of the grasp [N]."""
    dt = 1e-3
    accelerations = np.concatenate(
        [lift_acceleration(motion, dt), oscillation_acceleration(motion, dt)]
    )
    felt = np.array([0.0, 0.0, -motion.gravity]) - accelerations
    return mass_kg * float(np.linalg.norm(felt, axis=1).max())


def _carry(
    engine: Engine, config: ValidationConfig, case: tuple[float, float]
) -> tuple[str, float, str]:
    """Return why the cube fell, what friction can carry [N], and both in words."""
    force_n, friction = case
    slip = with_hand(config.slip, force_n, friction)
    trial = cube_trial(config.stages.capacity_mass_kg, DOWN[None], config.hand)
    failure = run_slip_test(trial, slip, geometry=config.hand, engine=engine).failures[0]
    capacity = 2.0 * friction * force_n
    words = f"{capacity:g} N ({force_n:g} N, mu {friction:g}): {failure or 'held'}"
    return failure, capacity, words


def _approaches() -> Array:
    """Return rotations (3, 3, 3) of the hand: from above, from the side, askew."""
    side = se3.exp_so3([0.0, np.pi / 2, 0.0])
    askew = se3.exp_so3([0.2, 0.6, 0.3]) @ DOWN
    return np.stack([DOWN, side, askew])


def _per_stage(values: Array) -> str:
    """Return the stages' values in words."""
    return "by stage " + ", ".join(f"{v:.3g}" for v in values)
