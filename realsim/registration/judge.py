"""Every check of a registration without ground truth, and the verdict of each object."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.records import ObjectPose, SupportPlane
from realsim.registration.body import Body
from realsim.registration.compare import Comparer
from realsim.registration.config import RegistrationConfig
from realsim.registration.evidence import Cloud
from realsim.registration.intake import Intake, scene_cloud
from realsim.registration.judging.held_out import held_out, owned_points
from realsim.registration.judging.scene_checks import SceneFinding, scene_findings
from realsim.registration.judging.surface_residuals import (
    error_level_m,
    residual_checks,
    size_error,
    surface_residuals,
)
from realsim.registration.judging.verdict import REJECT, probability_right, verdict_of
from realsim.registration.odometry.cross_check import Fault
from realsim.registration.refinement.flat import is_flat
from realsim.registration.refinement.refine import area_at
from realsim.registration.rivals_around import Around
from realsim.registration.search.flat_search import FLAT_HEIGHT_M, cover, explained_at, table_map
from realsim.registration.table_planes import support_checks
from realsim.registration.verify import Checked, verify_objects
from realsim.registration.view_agreement import ViewFinding

ONE_VIEW_CHECKS = ("residual_bound_mm",)
"""What the surface residuals of a single view are good for."""
COMMON = ("common shift", "common sinking")
"""Findings on the scene's starts, depth or models that speak against no single pose."""
FLAT_SIGMAS = 2.0
"""A table may be off by so many of its sigmas under an object."""
WORST = ("accepted", "doubtful", "rejected")
"""Verdicts, better first."""


Defect = ViewFinding | SceneFinding | Fault
"""Something that is wrong with a view, or with the scene as a whole."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Poses:
    """What is judged."""

    bodies: list[Body]
    poses: list[Array]
    clouds: list[Cloud]
    covariances: list[Array | None]
    blind: list[int]
    """Axes that nothing determines, per object."""
    contrasts: list[float | None]
    """Against the best near-symmetric rival, per object."""
    cameras: Array
    """(V, 4, 4) of all views, refined if they were; cameras that stand still are last."""
    plane: SupportPlane | None
    known: tuple[SceneFinding, ...]
    """What has been found wrong with the objects before."""
    with_starts: bool
    """Whether the bodies' starts were claimed by somebody."""
    table_off_m: float = 0.0
    """By how much the table is not flat, 1-sigma [m]."""
    around: Sequence[Around] = ()
    """What the images say of each pose and those around it; empty with many views."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Judgement:
    """The judged objects and what is wrong with the scene."""

    objects: list[ObjectPose]
    findings: Sequence[Defect]


def judge_objects(
    intake: Intake, given: Poses, comparer: Comparer, config: RegistrationConfig
) -> Judgement:
    """Return the objects with checks, probability, verdict and reasons."""
    checked = verify_objects(given.bodies, given.poses, given.clouds, comparer)
    features = _features(intake, given, checked, config)
    probabilities = [probability_right(f) for f in features]
    if given.around:
        # Of few views half of the right poses look improbable to checks that were set on many;
        # they warn below `reject`, and what the views leave open decides.
        probabilities = [
            a.probability * min(1.0, p / REJECT)
            for a, p in zip(given.around, probabilities, strict=True)
        ]
    # A single view leaves probabilities low; what the bounds do not reject still moved alike.
    one = len(intake.views) == 1
    usable = [c.verdict != "rejected" for c in checked] if one else None
    findings = scene_findings(
        given.bodies, given.poses, probabilities, scene_cloud(intake, given.cameras, given.plane),
        comparer, given.with_starts, usable,
    )  # fmt: skip
    findings = [*given.known, *findings]
    objects = [
        _object(given, k, checked[k], features[k], probabilities[k], findings)
        for k in range(len(given.bodies))
    ]
    return Judgement(objects=objects, findings=findings)


def _features(
    intake: Intake, given: Poses, checked: Sequence[Checked], config: RegistrationConfig
) -> list[dict[str, float | None]]:
    """Return everything that is known of every object, by name."""
    residuals = surface_residuals(
        given.bodies, given.poses, intake.intrinsics, intake.all_views, given.cameras, intake.noise,
        given.plane,
    )  # fmt: skip
    level = error_level_m(residuals)
    held = support_checks(given.bodies, given.poses, given.plane, FLAT_SIGMAS * given.table_off_m)
    halves: list[dict[str, float]] = [{} for _ in given.bodies]
    if len(intake.views) >= config.refine_from and given.bodies:
        owned = owned_points(
            given.bodies, given.poses, intake.intrinsics, intake.views,
            given.cameras[: len(intake.views)], intake.noise, given.plane,
        )  # fmt: skip
        found = held_out(given.bodies, given.poses, owned, len(intake.views))
        halves = [h.checks() for h in found]
    flat = flat_checks(intake, given, config)
    surfaces = [
        residual_checks(r, level) | {"size_error": size_error(r, b.center_obj, level) or 0.0}
        for r, b in zip(residuals, given.bodies, strict=True)
    ]
    if len(intake.views) == 1:
        # One view shows too little of a surface for its patches to say anything.
        surfaces = [{name: s[name] for name in ONE_VIEW_CHECKS} for s in surfaces]
    return [
        {
            **c.checks, **r, **s, **h, **f,
            "contrast": contrast, "views": float(len(intake.views)),
        }
        for c, r, s, h, f, contrast in zip(
            checked, surfaces, held, halves, flat, given.contrasts, strict=True
        )
    ]  # fmt: skip


def flat_checks(intake: Intake, given: Poses, config: RegistrationConfig) -> list[dict[str, float]]:
    """Return of every flat object what share of the heights around it its pose explains.

    A card that is slid over the table agrees with all depth to its thickness; the mean heights of
    all views tell where it lies. Nothing of other objects, and nothing of too few views.
    """
    plane = given.plane
    checks: list[dict[str, float]] = [{} for _ in given.bodies]
    if plane is None or len(intake.views) < config.refine_from:
        return checks
    T_table = se3.invert(plane.T_world_table)
    both = list(zip(given.bodies, given.poses, strict=True))
    flat = [k for k, (b, T) in enumerate(both) if is_flat(b, T_table @ T, FLAT_HEIGHT_M)]
    if not flat:
        return checks
    middle = np.mean([b.center(T) for b, T in both], axis=0)
    area_px = area_at(intake.intrinsics.width)
    map_ = table_map(intake.views, plane, intake.noise, middle, area_px)
    for k in flat:
        rest = map_
        for body, T in (*both[:k], *both[k + 1 :]):
            rest = cover(rest, body, T)
        share = explained_at(rest, *both[k], given.table_off_m)
        # What is hidden all around lies there as well as anywhere.
        checks[k]["explained"] = 0.0 if share is None else share
    return checks


def _object(
    given: Poses,
    k: int,
    checked: Checked,
    features: Mapping[str, float | None],
    probability: float,
    findings: Sequence[SceneFinding],
) -> ObjectPose:
    """Return one object with its verdict: the worse of the bounds' and the probability's."""
    body = given.bodies[k]
    verdict, reasons = verdict_of(probability, features)
    if given.around and verdict != "accepted":
        # Not knowing is no reason to reject: the bounds do that.
        verdict = "doubtful"
        unlike = [given.around[k].unlike] if given.around[k].unlike else []
        unseen = [f"not seen in so few views: {w}" for w in given.around[k].unseen]
        reasons = (*reasons, *unlike, *unseen)
    if WORST.index(checked.verdict) > WORST.index(verdict):
        verdict, reasons = checked.verdict, (*checked.reasons, *reasons)
    size = features.get("size_error") or 0.0
    if size != 0.0 and verdict != "accepted":
        reasons = (
            *reasons,
            f"its surface looks {100 * abs(size):.0f} % {'larger' if size > 0 else 'smaller'} than "
            "its model's, at least: the model, or the depth, may have the wrong scale. Measure "
            "the object, and whether the depth's unit is right; or run "
            f"`realsim scan scale {body.model.name} SESSION`",
        )
    mine = [f for f in findings if body.start.instance in f.instances and f.kind not in COMMON]
    if mine:
        reasons = (*reasons, *(f.words for f in mine))
        if verdict == "accepted":
            verdict = "doubtful"
    known = {**features, "probability": probability, "blind_axes": given.blind[k]}
    checks = {n: float(v) for n, v in known.items() if v is not None and np.isfinite(v)}
    return ObjectPose(
        obj_id=body.start.obj_id, instance=body.start.instance, T_world_obj=given.poses[k],
        covariance=given.covariances[k], checks=checks, verdict=verdict, reasons=reasons,
    )  # fmt: skip
