"""The validation suite: one engine at its settings, all checks, one report.

Grasps through all four stages whose outcome is known: the symmetric box, and too weak a hand.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.hand import Hand
from realsim_sim_bridge.slip.engines import BulletSettings, MujocoSettings, make_engine
from realsim_sim_bridge.slip.motion import SlipMotion, lift_acceleration, oscillation_acceleration
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import SlipConfig, Slips, run_slip_test
from realsim_sim_bridge.slip.world import Engine, PadModel
from realsim_sim_bridge.validation.config import CHECKS, ValidationConfig
from realsim_sim_bridge.validation.full_arm import arm_checks
from realsim_sim_bridge.validation.labels import (
    LabelChecks,
    MakeEngine,
    Settings,
    edge_config,
    reference_check,
)
from realsim_sim_bridge.validation.loads import with_hand
from realsim_sim_bridge.validation.report import CheckResult, LimitRatio, ValidationReport
from realsim_sim_bridge.validation.slip_limits import (
    creep_checks,
    curved_check,
    force_check,
    limit_checks,
    press_checks,
)
from realsim_sim_bridge.validation.specimens import DOWN, OPENING_M, SIDE_M, cube_trial, edge_trial


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


# --- What the engine says its settings are, whether it repeats itself, and whether pairs are alone


MASSES_KG = (0.013, 0.5)
"""On both sides of the mass floor."""
COMPANY = 4
"""Grasps in a world."""


def settings_check(
    engine: Engine, config: ValidationConfig, settings: BulletSettings | MujocoSettings
) -> CheckResult:
    """Return the greatest relative difference between what was asked and what the engine says."""
    worst, where = 0.0, ""
    for force_n, friction in config.limits.cases:
        slip = with_hand(config.slip, force_n, friction)
        for mass in MASSES_KG:
            asked = _asked(slip, mass, settings)
            found = _found(engine, slip, mass, config.hand)
            for name, value in asked.items():
                error = abs(found.get(name, float("nan")) - value) / (abs(value) or 1.0)
                if not error <= worst:
                    worst, where = error, f"{name} is {found.get(name)}, asked was {value}"
    names = ", ".join(_asked(config.slip, MASSES_KG[0], settings))
    return CheckResult(
        group="settings", name="settings read back",
        what="relative difference of a setting, read back from the engine",
        measured=worst, unit="", limit=config.stages.settings_tolerance, detail=where or names,
    )  # fmt: skip


def repeat_checks(engine: Engine, config: ValidationConfig) -> list[CheckResult]:
    """Return whether the same call gives the same bits, and what company does to a grasp."""
    labels = config.labels
    mass = labels.masses_kg[len(labels.masses_kg) // 2]
    slip = edge_config(config, mass)
    differing = held = same = tried = alone = 0
    apart_m = 0.0
    for shape in labels.shapes:
        trial = edge_trial(shape, mass, COMPANY, labels.seed, config.hand)
        together = run_slip_test(trial, slip, geometry=config.hand, engine=engine)
        again = run_slip_test(trial, slip, geometry=config.hand, engine=engine)
        differing += sum(not a for a in _equal_bits(together, again))
        held, tried = held + int(together.passed.sum()), tried + len(trial)
        for k in (0, COMPANY - 1):
            one = run_slip_test(
                trial.part(slice(k, k + 1)), slip, geometry=config.hand, engine=engine
            )
            alone += 1
            same += bool(together.passed[k] == one.passed[0])
            if together.passed[k] and one.passed[0]:
                apart_m = max(apart_m, float(np.abs(together.slip_m[k] - one.slip_m[0]).max()))
    company = f"{alone} grasps alone and among {COMPANY}"
    return [
        CheckResult(
            group="repeat", name="bit-equal repeat",
            what="grasps whose slips differ in any bit when the same call is made twice",
            measured=float(differing), unit="", limit=0.0, detail=f"{tried} grasps, {held} held",
        ),
        CheckResult(
            group="repeat", name="batch independence, labels",
            what="share of grasps with the same label alone and among others",
            measured=same / alone, unit="", limit=1.0, at_least=True, detail=company,
        ),
        CheckResult(
            group="repeat", name="batch independence, slip",
            what="difference of a held grasp's slip, alone and among others",
            measured=1e3 * apart_m, unit="mm", limit=1e3 * config.stages.pair_slip_m,
            detail=company,
        ),
    ]  # fmt: skip


def _asked(
    slip: SlipConfig, mass_kg: float, settings: BulletSettings | MujocoSettings
) -> dict[str, float]:
    """Return what the engine should say."""
    physics = slip.physics
    asked = {
        "friction": physics.friction,
        "object_mass_kg": max(mass_kg, physics.mass_floor_kg),
        "force_n": physics.force_n,
    }
    if physics.pads:
        asked["pad_stiffness_n_per_m"] = physics.pads.pad_stiffness_n_per_m
    if isinstance(settings, BulletSettings):
        asked["dt_s"] = 1.0 / settings.rate_hz
        asked |= {"iterations": float(settings.iterations), "substeps": 0.0}
        if physics.pads:
            asked["contact_damping"] = settings.damping
    else:
        asked["dt_s"] = settings.step_s
    return asked


def _found(engine: Engine, slip: SlipConfig, mass_kg: float, hand: Hand) -> dict[str, float]:
    """Return what the engine says of a closed world, with the friction that its rule makes."""
    trial = cube_trial(mass_kg, DOWN[None], hand)
    grips = trial.grips(slip.headroom_m)
    with engine.world(trial.met(slip.physics, hand), grips) as world:
        world.close(slip.closing)
        found: dict[str, Any] = world.settings()
    pair = found["finger_friction"], found["object_friction"]
    # Bullet multiplies the two surfaces' coefficients; MuJoCo takes the greater one.
    found["friction"] = pair[0] * pair[1] if engine.name == "pybullet" else max(pair)
    return found


def _equal_bits(a: Slips, b: Slips) -> list[bool]:
    """Return for every grasp whether all its figures are the same to the bit."""
    fields = asdict(a), asdict(b)
    return [
        all(
            np.asarray(fields[0][name][k]).tobytes() == np.asarray(fields[1][name][k]).tobytes()
            for name in ("slip_m", "slip_rad", "force_n", "duration_s")
        )
        and a.failures[k] == b.failures[k]
        for k in range(len(a.failures))
    ]


Progress = Callable[[str, int, int], None]


def validate(
    engine_settings: Settings,
    config: ValidationConfig | None = None,
    progress: Progress | None = None,
    make: MakeEngine = make_engine,
) -> ValidationReport:
    """Return what an engine gets right at its settings.

    Args:
        engine_settings: the engine and how it is set.
        config: the physics, which checks run and how many samples they take.
        progress: called with (part that begins, parts done, parts).
        make: makes an engine of settings.

    Raises:
        InputError: the engine is not installed, a part's name is unknown, or the hand does not open
            wide enough for the suite's cube.
    """
    config = config or ValidationConfig()
    _check_config(config)
    config = replace(config, slip=replace(config.slip, engine=engine_settings))
    began = time.process_time()
    engine = make(engine_settings)
    wanted = tuple(c for c in CHECKS if c in config.checks)
    labels = LabelChecks(make, engine_settings, config)
    checks: list[CheckResult] = []
    ratios: list[LimitRatio] = []
    for i, part in enumerate(wanted):
        if progress is not None:
            progress(part, i, len(wanted))
        if part == "settings":
            checks += [
                settings_check(engine, config, engine_settings),
                force_check(engine, config),
                *press_checks(engine, config),
            ]
        elif part in ("coulomb", "torque"):
            found, measured = limit_checks(engine, config, part)
            checks, ratios = checks + found, ratios + measured
        elif part == "creep":
            checks += [*creep_checks(engine, config), curved_check(engine, config)]
        elif part == "box":
            checks += box_checks(engine, config)
        elif part == "capacity":
            checks += capacity_checks(engine, config)
        elif part == "repeat":
            checks += repeat_checks(engine, config)
        elif part == "convergence":
            checks += labels.convergence()
        elif part == "replay":
            checks += labels.replay()
        elif part == "full_arm":
            checks += arm_checks(engine, config)
        else:
            checks.append(reference_check(engine, config))
    return ValidationReport(
        engine=engine.name,
        version=engine.version(),
        settings={
            "engine": asdict(engine_settings),
            "physics": asdict(config.slip.physics),
            "hand": {"name": config.hand.name, "digest": config.hand.digest},
        },
        checks=tuple(checks),
        ratios=tuple(ratios),
        cpu_s=time.process_time() - began,
    )


def _check_config(config: ValidationConfig) -> None:
    """Raise if a part of the suite is asked for that there is not, or the hand takes no cube."""
    checks, hand = config.checks, config.hand
    unknown = [c for c in checks if c not in CHECKS]
    if unknown or not checks:
        asked = f"no part '{unknown[0]}'" if unknown else "nothing to do"
        raise InputError(f"the validation suite has {asked}; its parts are: {', '.join(CHECKS)}.")
    if hand.max_opening_m < OPENING_M:
        raise InputError(
            f"the validation suite grasps a cube of {1e3 * SIDE_M:.0f} mm, and the hand "
            f"'{hand.name}' opens {1e3 * hand.max_opening_m:.0f} mm only. Validate "
            f"the engine with a hand that opens {1e3 * OPENING_M:.0f} mm or more; its settings "
            "are the same for every hand."
        )
