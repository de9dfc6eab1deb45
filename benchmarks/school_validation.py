"""The validation suite as a user runs it, for both engines; and PyBullet as it comes, as a rival.

`realsim school validate` prints the same checks one by one; here each figure is the worst of both
engines.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from figures import Found
from school_cases import in_processes

from realsim_sim_bridge.slip.engines import BulletSettings, settings_of
from realsim_sim_bridge.slip.slip_test import SlipConfig
from realsim_sim_bridge.slip.world import Replay, SlipPhysics
from realsim_sim_bridge.validation.config import CHECKS, LabelConfig, ValidationConfig
from realsim_sim_bridge.validation.report import CheckResult, ValidationReport
from realsim_sim_bridge.validation.suite import validate

ENGINES = ("pybullet", "mujoco")
RIVAL = "PyBullet's own settings"
LIGHT_KG = 0.013
LIGHT_GRASPS, LIGHT_GRASPS_QUICK = 10, 1
"""Grasps of each of the four shapes."""
QUICK_CHECKS = ("coulomb", "torque", "box")


@dataclass(frozen=True, kw_only=True, slots=True)
class SuiteJob:
    """A part of the suite."""

    engine: str
    """One of ENGINES, or RIVAL."""
    part: str
    """One of CHECKS, or 'light'."""
    quick: bool


def run_suite(job: SuiteJob) -> ValidationReport:
    """Return the report of a part."""
    config = ValidationConfig().quick() if job.quick else ValidationConfig()
    part = job.part
    if part == "light":
        part = "convergence"
        light = LabelConfig(
            masses_kg=(LIGHT_KG,),
            grasps=LIGHT_GRASPS_QUICK if job.quick else LIGHT_GRASPS,
            finer=((4, 1),),
        )
        config = replace(config, labels=light)
    config = replace(config, checks=(part,))
    if job.engine != RIVAL:
        return validate(settings_of(job.engine), config)
    # The finger's bare box, the object's true mass, and nothing but the friction set.
    settings = BulletSettings(
        rate_hz=240.0, iterations=50, friction_anchor=False, collision_margin_m=0.001,
        replay=Replay(),
    )  # fmt: skip
    bare = SlipConfig(sure=None, physics=SlipPhysics(pads=None, mass_floor_kg=0.0))
    return validate(settings, replace(config, slip=bare))


def validation(seed: int, keep: Path, quick: bool) -> Found:
    """Return the suite's figures; it has grasps and a seed of its own."""
    parts = QUICK_CHECKS if quick else CHECKS
    dear = ("convergence", "light", "replay", "full_arm")
    jobs = [
        SuiteJob(engine=engine, part=part, quick=quick)
        for part in sorted((*parts, "light"), key=lambda p: p not in dear)
        for engine in ENGINES
    ]
    jobs += [SuiteJob(engine=RIVAL, part=part, quick=quick) for part in ("coulomb", "box")]
    reports = dict(zip(jobs, in_processes(run_suite, jobs), strict=True))
    found = Found()
    ours = {job: report for job, report in reports.items() if job.engine != RIVAL}
    rival = {job: report for job, report in reports.items() if job.engine == RIVAL}
    for part in ("coulomb", "torque"):
        found.add(f"{part}_worst_pct", *_worst_limit(ours, part))
    box = _worst_box(ours)
    for key, value in box.items():
        found.add(key, value, "cubes of 125 and 13 g, 3 approaches, both engines")
    light = {job.engine: r.checks[0] for job, r in ours.items() if job.part == "light"}
    words = "; ".join(f"{engine} {check.measured:.3f}" for engine, check in light.items())
    found.add(
        "light_convergence_share",
        min(check.measured for check in light.values()),
        f"13 g, step / 4, {4 * (LIGHT_GRASPS_QUICK if quick else LIGHT_GRASPS)} grasps: {words}",
    )
    _add_failures(ours, found)
    value, over = _worst_limit(rival, "coulomb")
    found.rivals["coulomb_worst_pct"] = f"{RIVAL}: {value:.3g} ({over})"
    for key, value in _worst_box(rival).items():
        found.rivals[key] = f"{RIVAL}: {value:.3g}"
    return found


def _worst_limit(reports: dict[SuiteJob, ValidationReport], part: str) -> tuple[float, str]:
    """Return the greatest error of a limit [%] and where it is."""
    ratios = [
        (job, r) for job, report in reports.items() if job.part == part for r in report.ratios
    ]
    job, worst = max(ratios, key=lambda pair: pair[1].error)
    return (
        round(100.0 * worst.error, 6),
        f"worst of {len(ratios)}: {job.engine}, {worst.load}, {worst.case}",
    )


def _worst_box(reports: dict[SuiteJob, ValidationReport]) -> dict[str, float]:
    """Return least score, greatest slip and greatest turn of the cubes."""
    checks = [c for job, r in reports.items() if job.part == "box" for c in r.checks]

    def of(word: str) -> list[float]:
        return [c.measured for c in checks if c.name.endswith(word)]

    return {
        "box_score": min(of("score")),
        "box_slip_mm": max(of("slip")),
        "box_slip_deg": max(of("turn")),
    }


def _add_failures(reports: dict[SuiteJob, ValidationReport], found: Found) -> None:
    """Note how many checks of the suite failed, and which."""
    checks: list[tuple[str, CheckResult]] = [
        (job.engine, c) for job, r in reports.items() for c in r.checks
    ]
    failed = [(engine, c) for engine, c in checks if not c.passed]
    parts = len({job.part for job in reports} - {"light"})
    found.add("suite_checks_failed", float(len(failed)), f"of {len(checks)}, {parts} parts")
    for engine, c in failed:
        sign = ">=" if c.at_least else "<="
        found.notes.append(
            f"validation: {engine} fails '{c.name}': {c.measured:.4g} {c.unit}, {sign} "
            f"{c.limit:.4g} was wanted; {c.detail}"
        )
    cpu_s = sum(r.cpu_s for r in reports.values())
    found.notes.append(f"validation: {len(checks)} checks of both engines in {cpu_s:.0f} CPU s")
    found.cases["validation"] = [
        {"engine": engine} | c.to_json() for engine, c in checks if np.isfinite(c.measured)
    ]
