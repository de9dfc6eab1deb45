"""Whether labels depend on how they were made: fast or slow settings, one engine or the other.

The same grasps, all reached by the arm in a scene of ten objects, are tried by both engines in both
conditions. Held = the object is still between both fingers after all four stages, however far it
slipped; passed = under the paper's limits, which the same slips tell.

The independent contact model of `realsim school validate` judges both on its own specimens.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from figures import Found
from school_cases import (
    CONDITIONS,
    MARGINAL_DENSITY,
    NamedTrial,
    TrialKey,
    candidate_config,
    in_processes,
    of_density,
    reached_trial,
    school_case,
    slip_config,
    spent,
)

from realsim.arrays import Mask
from realsim.formats.grasps.scene_grasps import executed
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.school.cross_check import wilson_interval
from realsim_sim_bridge.school.measure_statistics import closure_confusions, rank_correlations
from realsim_sim_bridge.school.school import run_school
from realsim_sim_bridge.school.sweep import SweepConfig
from realsim_sim_bridge.slip.engines import make_engine, settings_of
from realsim_sim_bridge.slip.score import ScoreLimits
from realsim_sim_bridge.slip.slip_test import run_slip_test
from realsim_sim_bridge.validation.config import ReferenceConfig, ValidationConfig
from realsim_sim_bridge.validation.labels import PATIENT, ReferenceLabels, reference_labels
from realsim_sim_bridge.validation.reference_contact import ReferenceEngine

ENGINES = ("pybullet", "mujoco")
KINDS = ("reference", "fast", "sure")
FULL = (40, 16)
"""Grasps of each object, and how many of them are tried with the reference settings as well."""
QUICK = (3, 1)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Attempt:
    """Grasps of an object, and how they are tried."""

    named: NamedTrial
    engine: str
    condition: str
    kind: str
    """'reference' or 'fast', all stages simulated, or 'sure', as the School does."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Labels:
    """What came of it."""

    held: Mask
    passed: Mask
    """(N,) each."""


AnyLabels = Labels | ReferenceLabels


def labels_of(attempt: Attempt) -> Labels:
    """Return the labels of an object's grasps."""
    trial = attempt.named.trial
    if attempt.condition == "marginal":
        trial = of_density(trial, MARGINAL_DENSITY)
    reference = attempt.kind == "reference"
    config = slip_config(attempt.engine, attempt.condition, trial.body.mass_kg, reference=reference)
    if attempt.kind == "fast":
        config = replace(config, sure=None)
    slips = run_slip_test(trial, config, PATIENT)
    return Labels(held=slips.passed, passed=slips.scores(ScoreLimits())[1] >= 1.0)


def agreement(seed: int, keep: Path, quick: bool) -> Found:
    """Return the agreement of settings and of engines."""
    grasps, judged = QUICK if quick else FULL
    keys = [
        TrialKey(seed=seed, instance=o.instance, grasps=grasps, keep=keep, quick=quick)
        for o in school_case(seed, keep, quick).scene.objects
    ]
    trials = [t for t in in_processes(reached_trial, keys) if t is not None]
    firsts = [
        NamedTrial(name=t.name, instance=t.instance, trial=t.trial.part(slice(0, judged)))
        for t in trials
    ]
    attempts = [
        Attempt(named=t, engine=engine, condition=condition, kind=kind)
        for kind, engine, condition in product(KINDS, ENGINES, CONDITIONS)
        for t in (firsts if kind == "reference" else trials)
    ]
    found = in_processes(labels_of, attempts)
    table: dict[tuple[str, str, str], list[Labels]] = {}
    for attempt, labels in zip(attempts, found, strict=True):
        key = (attempt.engine, attempt.condition, attempt.kind)
        table.setdefault(key, []).append(labels)
    return _figures(table, [t.name for t in trials])


def _figures(table: dict[tuple[str, str, str], list[Labels]], names: list[str]) -> Found:
    """Return the figures out of all labels by engine, condition and settings, one an object."""
    found = Found()
    fast: dict[str, float] = {}
    for engine, condition in product(ENGINES, CONDITIONS):
        reference = table[engine, condition, "reference"]
        first = [
            Labels(held=a.held[: len(b.held)], passed=a.passed[: len(b.held)])
            for a, b in zip(table[engine, condition, "fast"], reference, strict=True)
        ]
        fast[f"{engine}, {condition}"] = _share(first, reference, "held")
        found.notes.append(
            f"fast and reference settings, {engine}, {condition}: "
            f"{_words(first, reference, 'held')}; {_words(first, reference, 'passed')}"
        )
    where = min(fast, key=lambda k: fast[k])
    count = sum(len(r.held) for r in table["pybullet", "plain", "reference"])
    found.add("fast_agree_share", fast[where], f"held, {count} grasps; the worst of 4: {where}")
    kept: dict[str, float] = {}
    for engine, condition in product(ENGINES, CONDITIONS):
        a, b = (table[engine, condition, kind] for kind in ("sure", "fast"))
        kept[f"{engine}, {condition}"] = _share(a, b, "passed")
        found.notes.append(f"sure or simulated, {engine}, {condition}: {_words(a, b, 'passed')}")
    where = min(kept, key=lambda k: kept[k])
    found.add("sure_agree_share", kept[where], f"passed, the worst of 4: {where}")
    for condition in CONDITIONS:
        a, b = (table[engine, condition, "fast"] for engine in ENGINES)
        key = "engines_agree_share" if condition == "plain" else "engines_agree_marginal_share"
        found.add(key, _share(a, b, "held"), _words(a, b, "held"))
        found.notes.append(f"engines, {condition}: {_words(a, b, 'passed')}")
        by_object = [
            f"{name} {int(np.sum(x.held != y.held))}"
            for name, x, y in zip(names, a, b, strict=True)
        ]
        found.notes.append(f"engines, {condition}, differing held labels: {', '.join(by_object)}")
    both = [x.held for engine in ENGINES for x in table[engine, "marginal", "fast"]]
    dropped = 1.0 - float(np.mean(np.concatenate(both)))
    found.add("marginal_dropped_share", dropped, "not held, the mean of both engines")
    found.cases["agreement"] = {
        ", ".join((engine, condition, kind)): {
            name: ["".join("01"[int(v)] for v in x.held), "".join("01"[int(v)] for v in x.passed)]
            for name, x in zip(names, labels, strict=True)
        }
        for (engine, condition, kind), labels in table.items()
    }
    return found


def _same(a: Sequence[AnyLabels], b: Sequence[AnyLabels], kind: str) -> Mask:
    """Return whether each label is the same, all objects one after the other."""
    first = np.concatenate([getattr(x, kind) for x in a])
    return first == np.concatenate([getattr(x, kind) for x in b])


def _share(a: Sequence[AnyLabels], b: Sequence[AnyLabels], kind: str) -> float:
    """Return the share of equal labels."""
    return float(np.mean(_same(a, b, kind)))


def _words(a: Sequence[AnyLabels], b: Sequence[AnyLabels], kind: str) -> str:
    """Return the agreement in words, with its 95 % interval."""
    same = _same(a, b, kind)
    low, high = wilson_interval(int(same.sum()), len(same))
    shares = [100 * float(np.mean(np.concatenate([getattr(x, kind) for x in s]))) for s in (a, b)]
    return (
        f"{kind} {same.mean():.3f} [{low:.3f}, {high:.3f}] of {len(same)} grasps "
        f"({shares[0]:.0f} and {shares[1]:.0f} % {kind})"
    )


# --- The engines and a contact model that shares nothing with them -------------------------------


REFERENCE, REFERENCE_QUICK = 6, 1
"""Grasps of each of seven shapes and two masses: 84 and 14."""
CONTACT_MODEL = "contact model"


@dataclass(frozen=True, kw_only=True, slots=True)
class SpecimenJob:
    """A specimen, and what tries it."""

    engine: str
    """One of ENGINES, or CONTACT_MODEL."""
    shape: str
    masses_kg: tuple[float, ...]
    grasps: int
    seed: int


def specimen_labels(job: SpecimenJob) -> ReferenceLabels:
    """Return what becomes of a specimen's grasps."""
    asked = ReferenceConfig(
        masses_kg=((job.shape, job.masses_kg),), grasps=job.grasps, seed=job.seed
    )
    model = job.engine == CONTACT_MODEL
    engine = ReferenceEngine() if model else make_engine(settings_of(job.engine))
    return reference_labels(engine, replace(ValidationConfig(), reference=asked))


def reference(given: argparse.Namespace) -> Found:
    """Return how often each engine holds or drops what the independent contact model does."""
    grasps = REFERENCE_QUICK if given.quick else REFERENCE
    jobs = [
        SpecimenJob(engine=name, shape=shape, masses_kg=masses, grasps=grasps, seed=given.seed)
        for name in (CONTACT_MODEL, *ENGINES)
        for shape, masses in ReferenceConfig().masses_kg
    ]
    labels: dict[str, list[ReferenceLabels]] = {}
    for job, one in zip(jobs, in_processes(specimen_labels, jobs), strict=True):
        labels.setdefault(job.engine, []).append(one)
    found, shares = Found(), dict[str, float]()
    judge = labels[CONTACT_MODEL]
    for engine in ENGINES:
        same = _same(labels[engine], judge, "held")
        shares[engine] = float(same.mean())
        names = [name for one in judge for name in one.shapes]
        differing = [n for n, equal in zip(names, same.tolist(), strict=True) if not equal]
        found.notes.append(
            f"contact model and {engine}: {_words(labels[engine], judge, 'held')}; "
            f"{_words(labels[engine], judge, 'passed')}; differing: {', '.join(differing)}"
        )
    worse = min(shares, key=lambda k: shares[k])
    count = sum(len(one.held) for one in judge)
    found.add("reference_agree_share", shares[worse], f"held, {count} grasps; the worse: {worse}")
    found.cases["contact model"] = {
        name: {
            one.shapes[0].split()[0]: [
                "".join("01"[int(v)] for v in x) for x in (one.held, one.passed)
            ]
            for one in all_shapes
        }
        for name, all_shapes in labels.items()
    }
    return found


# --- How margin, score and analytic quality rank the same grasps ---------------------------------
# At 70 N and friction 1 most grasps pass, so the score has many ties; the margin, from the least
# friction and the least force that a grasp survives, has few.


ENGINE = "mujoco"
"""The fast one: a margin takes nine slip tests."""
SWEPT, SWEPT_QUICK = 42, 3
"""Candidates per object."""
KEYS = {
    ("score", "margin"): "rank_margin_score",
    ("margin", "ferrari_canny"): "rank_margin_closure",
    ("score", "ferrari_canny"): "rank_score_closure",
    ("margin", "closure_friction"): "rank_margin_closure_friction",
    ("score", "closure_friction"): "rank_score_closure_friction",
}


def margins(seed: int, keep: Path, quick: bool) -> Found:
    """Return the rank correlations with their intervals."""
    case = school_case(seed, keep, quick)
    config = SchoolConfig(
        seed=seed, max_candidates=SWEPT_QUICK if quick else SWEPT,
        candidates=candidate_config(quick), slip=slip_config(ENGINE, "plain", 1.0),
        sweep=SweepConfig(),
    )  # fmt: skip
    with spent() as cost:
        sets = run_school(case.scene, case.models, config, workers=2, solids=case.solids)
    # What the arm does not reach has no margin, which may be all of an object.
    swept = [s for s in sets if "margin" in s.measures]
    tried = sum(int(executed(s).sum()) for s in swept)
    found = Found()
    for c in rank_correlations(sets, np.random.default_rng([seed, 3])):
        key = KEYS.get((c.first, c.second))
        if key is not None:
            found.add(key, c.rho, f"Spearman, [{c.low:.2f}, {c.high:.2f}] of {c.grasps} grasps")
    scores = np.concatenate([s.scores[executed(s)] for s in swept])
    margin = np.concatenate([s.measures["margin"][executed(s)] for s in swept])
    found.notes.append(
        f"margins: {tried} grasps, {1e3 * cost.cpu_s / tried:.0f} CPU ms each; "
        f"{len(np.unique(scores))} different scores ({100 * np.mean(scores >= 1):.0f} % are 1), "
        f"{len(np.unique(margin))} different margins, of those with score 1 from "
        f"{margin[scores >= 1].min(initial=1):.2f} to {margin[scores >= 1].max(initial=0):.2f}"
    )
    for confusion in closure_confusions(sets):
        found.notes.append(
            f"margins: {confusion.closure} tells a score of 0.5 or more with a balanced accuracy "
            f"of {confusion.balanced_accuracy:.2f} ({confusion.grasps} grasps)"
        )
    return found
