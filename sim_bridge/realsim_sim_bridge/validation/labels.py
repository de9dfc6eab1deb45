"""Labels of grasps on the edge: they must not hang on time step, iterations, replay or engine."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from realsim.arrays import Array, Mask
from realsim_sim_bridge.slip.engines import BulletSettings, MujocoSettings
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import SlipConfig, SlipTrial, run_slip_test
from realsim_sim_bridge.slip.world import Engine
from realsim_sim_bridge.validation.config import ValidationConfig
from realsim_sim_bridge.validation.loads import with_hand
from realsim_sim_bridge.validation.reference_contact import ReferenceEngine
from realsim_sim_bridge.validation.report import CheckResult
from realsim_sim_bridge.validation.specimens import edge_trial, fits

Settings = BulletSettings | MujocoSettings
MakeEngine = Callable[[Settings], Engine]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class EdgeLabels:
    """Whether each grasp on the edge passed all four stages."""

    passed: Mask
    """(N,)."""
    masses_kg: Array
    """(N,) of the object of each [kg]."""


def edge_config(config: ValidationConfig, mass_kg: float) -> SlipConfig:
    """Return the slip test with a hand that is just strong enough for a mass [kg]."""
    labels = config.labels
    weight = mass_kg * config.slip.motion.gravity
    force_n = labels.capacity_ratio * weight / (2.0 * labels.friction)
    return with_hand(config.slip, min(force_n, config.slip.physics.force_n), labels.friction)


def edge_labels(engine: Engine, config: ValidationConfig, shift_m: float = 0.0) -> EdgeLabels:
    """Return the labels of all grasps on the edge.

    Args:
        engine: the engine, which plays as fast as its settings say.
        config: which grasps.
        shift_m: moves every grasp [m].
    """
    labels = config.labels
    passed: list[Mask] = []
    for mass in labels.masses_kg:
        for shape in labels.shapes:
            trial: SlipTrial = edge_trial(
                shape, mass, labels.grasps, labels.seed, config.hand, shift_m=shift_m
            )
            tried = run_slip_test(
                trial, edge_config(config, mass), geometry=config.hand, engine=engine
            )
            passed.append(tried.passed)
    return EdgeLabels(
        passed=np.concatenate(passed),
        masses_kg=np.repeat(labels.masses_kg, len(labels.shapes) * labels.grasps),
    )


def refined(settings: Settings, steps: int, iterations: int) -> Settings:
    """Return settings with the time step divided by `steps` and `iterations` times the iterations.

    They play at true speed: what is compared is the solver.
    """
    settings = at_true_speed(settings)
    if isinstance(settings, BulletSettings):
        return replace(
            settings, rate_hz=settings.rate_hz * steps, iterations=settings.iterations * iterations
        )
    # MuJoCo's Newton solver ends at its tolerance; what can be refined is the pass against slip.
    noslip = settings.noslip_iterations * iterations + 10 * (iterations - 1)
    return replace(settings, step_s=settings.step_s / steps, noslip_iterations=noslip)


def at_true_speed(settings: Settings) -> Settings:
    """Return settings that play every stage at true speed."""
    return replace(settings, replay=replace(settings.replay, speed=1))


class LabelChecks:
    """The comparisons of labels; they share those at the judged settings and true speed."""

    def __init__(self, make: MakeEngine, settings: Settings, config: ValidationConfig) -> None:
        """Keep what is compared; nothing is tried yet."""
        self._make, self._settings, self._config = make, settings, config

    def convergence(self) -> list[CheckResult]:
        """Return the agreement of the labels with those at finer settings."""
        config = self._config
        beside = edge_labels(
            self._make(at_true_speed(self._settings)), config, config.labels.jitter_m
        )
        jitter = f"{1e3 * config.labels.jitter_m:g} mm beside: {_share(self._true, beside):.3f}"
        return [self._finer(*finer, jitter) for finer in config.labels.finer]

    def replay(self) -> list[CheckResult]:
        """Return the agreement of fast with true replay; nothing where replay is at true speed."""
        speed, limit = self._settings.replay.speed, self._config.labels.replay_agreement
        if speed == 1:
            return []
        fast = edge_labels(self._make(self._settings), self._config)
        return [
            CheckResult(
                group="replay", name=f"labels at replay x {speed}",
                what="share of grasps on the edge with the same label at true speed",
                measured=_share(self._true, fast), unit="", limit=limit, at_least=True,
                detail=_by_mass(self._true, fast),
            )
        ]  # fmt: skip

    @cached_property
    def _true(self) -> EdgeLabels:
        """The labels at the judged settings and true speed."""
        return edge_labels(self._make(at_true_speed(self._settings)), self._config)

    def _finer(self, steps: int, iterations: int, jitter: str) -> CheckResult:
        """Return the agreement with one finer setting."""
        finer = edge_labels(self._make(refined(self._settings, steps, iterations)), self._config)
        changes = [f"step / {steps}"] if steps > 1 else []
        changes += [f"iterations x {iterations}"] if iterations > 1 else []
        return CheckResult(
            group="convergence", name=f"labels at {', '.join(changes)}",
            what="share of grasps on the edge with the same label at finer settings",
            measured=_share(self._true, finer), unit="", limit=self._config.labels.agreement,
            at_least=True, detail=f"{_by_mass(self._true, finer)}; {jitter}",
        )  # fmt: skip


def _share(a: EdgeLabels, b: EdgeLabels) -> float:
    """Return the share of equal labels."""
    return float(np.mean(a.passed == b.passed))


def _by_mass(a: EdgeLabels, b: EdgeLabels) -> str:
    """Return the number of differing labels of each mass, and how many were held, in words."""
    words = [
        f"{1e3 * m:g} g {int(np.sum((a.passed != b.passed)[a.masses_kg == m]))}"
        for m in np.unique(a.masses_kg).tolist()
    ]
    return f"{len(a.passed)} grasps, {100 * a.passed.mean():.0f} % held; differing at " + ", ".join(
        words
    )


# --- the engine against the independent contact model -------------------------------------------


PATIENT = ScoreLimits(slip_m=0.05, slip_deg=360.0)
"""Under these a grasp is held whose object is between both fingers at the end of all stages,
however far it slipped."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ReferenceLabels:
    """What became of the grasps that the contact model tries, too."""

    shapes: tuple[str, ...]
    """(N,) shape and mass of each."""
    held: Mask
    """(N,) still between both fingers at the end, however far it slipped."""
    passed: Mask
    """(N,) under the paper's limits of every stage besides."""


def reference_labels(engine: Engine, config: ValidationConfig) -> ReferenceLabels:
    """Return what an engine makes of the grasps of `ValidationConfig.reference`."""
    asked = config.reference
    slip = with_hand(config.slip, asked.force_n, asked.friction)
    shapes: list[str] = []
    held: list[Mask] = []
    passed: list[Mask] = []
    for shape, masses in asked.masses_kg:
        if not fits(shape, config.hand):
            continue
        for k, mass in enumerate(masses):
            trial = edge_trial(
                shape, mass, asked.grasps * len(masses), asked.seed, config.hand,
                lean_deg=asked.lean_deg,
            ).part(slice(k * asked.grasps, (k + 1) * asked.grasps))  # fmt: skip
            slips = run_slip_test(trial, slip, PATIENT, config.hand, engine)
            shapes += [f"{shape} {mass:g} kg"] * len(trial)
            held.append(slips.passed)
            passed.append(slips.passed & (slips.scores(ScoreLimits())[1] >= 1.0))
    return ReferenceLabels(
        shapes=tuple(shapes), held=np.concatenate(held), passed=np.concatenate(passed)
    )


def reference_check(engine: Engine, config: ValidationConfig) -> CheckResult:
    """Return the share of grasps that the independent contact model holds or drops as well."""
    found, judge = (reference_labels(e, config) for e in (engine, ReferenceEngine()))
    same = found.held == judge.held
    differing = [s for s, equal in zip(found.shapes, same.tolist(), strict=True) if not equal]
    wide = [shape for shape, _ in config.reference.masses_kg if not fits(shape, config.hand)]
    words = f"differing: {', '.join(differing) or 'none'}"
    words += f"; too wide for the hand: {', '.join(wide)}" if wide else ""
    return CheckResult(
        group="reference", name="labels of the contact model",
        what="share of grasps held or dropped as by an independent contact model",
        measured=float(same.mean()), unit="", limit=config.reference.agreement, at_least=True,
        detail=f"{len(same)} grasps, {int(judge.held.sum())} held; under the paper's limits "
        f"{np.mean(found.passed == judge.passed):.3f}; {words}",
    )  # fmt: skip
