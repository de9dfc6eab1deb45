"""The validation suite: one engine at its settings, all checks, one report."""

import time
from collections.abc import Callable
from dataclasses import asdict, replace

from realsim.errors import InputError
from realsim_sim_bridge.slip.engines import make_engine
from realsim_sim_bridge.validation.config import CHECKS, ValidationConfig
from realsim_sim_bridge.validation.full_arm import arm_checks
from realsim_sim_bridge.validation.known_outcomes import box_checks, capacity_checks
from realsim_sim_bridge.validation.labels import LabelChecks, MakeEngine, Settings
from realsim_sim_bridge.validation.repeat import repeat_checks, settings_check
from realsim_sim_bridge.validation.report import CheckResult, LimitRatio, ValidationReport
from realsim_sim_bridge.validation.slip_limits import (
    coulomb_checks,
    creep_checks,
    curved_check,
    force_check,
    torque_checks,
)

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
        InputError: the engine is not installed, or a part's name is unknown.
    """
    config = config or ValidationConfig()
    _check_names(config.checks)
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
            checks += [settings_check(engine, config, engine_settings), force_check(engine, config)]
        elif part in ("coulomb", "torque"):
            measure = coulomb_checks if part == "coulomb" else torque_checks
            found, measured = measure(engine, config)
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
        else:
            checks += arm_checks(engine, config)
    return ValidationReport(
        engine=engine.name,
        version=engine.version(),
        settings={"engine": asdict(engine_settings), "physics": asdict(config.slip.physics)},
        checks=tuple(checks),
        ratios=tuple(ratios),
        cpu_s=time.process_time() - began,
    )


def _check_names(checks: tuple[str, ...]) -> None:
    """Raise if a part of the suite is asked for that there is not."""
    unknown = [c for c in checks if c not in CHECKS]
    if unknown or not checks:
        asked = f"no part '{unknown[0]}'" if unknown else "nothing to do"
        raise InputError(f"the validation suite has {asked}; its parts are: {', '.join(CHECKS)}.")
