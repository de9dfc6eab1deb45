"""A registered scene, and what becomes of the objects in it that are rejected."""

from collections import Counter
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from typing import Any

from realsim.arrays import Array
from realsim.records import ObjectPose, Scene
from realsim.registration.finding import NO_INSTANCE
from realsim.registration.judge import COMMON, Defect
from realsim.registration.judging.verdict import ACCEPT
from realsim.registration.refinement.uncertainty import SeenPose
from realsim.registration.search.records import NotPlaced


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Registration:
    """A registered scene, its baseline, and how it came about."""

    scene: Scene
    """Poses with covariance, checks, verdict, reasons; and the support plane."""
    single_view: Scene
    """The baseline: robust ICP in one reference frame, checked in the same way."""
    cameras: dict[int, Array]
    """View number -> (4, 4) T_world_cam; refined if the views allow it. Views that were left out
    are not in it."""
    fixed_cameras: dict[str, Array]
    """Name -> (4, 4) T_world_cam of the cameras that stand still; refined if the views allow it."""
    seen: dict[int, dict[int, SeenPose]]
    """View number -> instance -> its pose in that view, with covariance and pixel uncertainty.
    Empty if cameras were not refined."""
    not_placed: tuple[NotPlaced, ...]
    """Objects that were wanted and not found, and why."""
    findings: tuple[Defect, ...]
    """What is wrong with views or with the scene."""
    report: Mapping[str, Any]
    """Plain JSON values: per object the search, the residuals, what was rejected; the cameras."""


def is_wrong(o: ObjectPose) -> bool:
    """Return whether an object is rejected by its own evidence.

    One that fits well and overlaps another may be right and the other wrong: it is judged again
    without those that are wrong by themselves.
    """
    fits = o.checks.get("probability", 0.0) >= ACCEPT
    return o.verdict == "rejected" and not (fits and o.checks.get("penetration_mm", 0.0) > 0.0)


def with_rejected(result: Registration, first: Registration, bad: AbstractSet[int]) -> Registration:
    """Return a registration with the objects that were rejected before it was made."""
    words = "it took no part in the fit of the cameras"
    out = [
        replace(o, reasons=(*o.reasons, words)) for o in first.scene.objects if o.instance in bad
    ]
    rows = [r for r in first.report["objects"] if r["instance"] in bad]
    seen = {
        view: poses | {i: p for i, p in first.seen.get(view, {}).items() if i in bad}
        for view, poses in result.seen.items()
    }
    objects = sorted((*result.scene.objects, *out), key=lambda o: o.instance)
    every = sorted((*result.report["objects"], *rows), key=lambda r: r["instance"])
    known = {(f.kind, f.words) for f in result.findings}
    lost = [f for f in first.findings if (f.kind, f.words) not in known and f.kind not in COMMON]
    return replace(
        result, scene=replace(result.scene, objects=tuple(objects)), seen=seen,
        findings=(*result.findings, *lost), report={**result.report, "objects": every},
    )  # fmt: skip


def without_inventions(result: Registration) -> Registration:
    """Return a registration of objects that nobody named, without those that were rejected.

    A model of which nothing is left is not placed; the report counts the places of all.
    """
    rejected = [o for o in result.scene.objects if o.verdict == "rejected"]
    gone = {o.instance for o in rejected}
    found = {o.obj_id for o in result.scene.objects if o.instance not in gone}
    counts = Counter(o.obj_id for o in rejected)
    first = {o.obj_id: o.reasons[0] for o in reversed(rejected)}
    lost = tuple(
        NotPlaced(
            obj_id=i,
            instance=NO_INSTANCE,
            reason=f"places tried: {counts[i]}, all rejected; the first: {first[i]}",
        )
        for i in sorted(set(counts) - found)
    )

    def is_of_them(finding: Defect) -> bool:
        of = set(getattr(finding, "instances", ()))
        return bool(of) and of <= gone

    findings = tuple(f for f in result.findings if not is_of_them(f))

    def kept(scene: Scene) -> Scene:
        return replace(scene, objects=tuple(o for o in scene.objects if o.instance not in gone))

    return replace(
        result, scene=kept(result.scene), single_view=kept(result.single_view),
        seen={v: {i: p for i, p in of.items() if i not in gone} for v, of in result.seen.items()},
        not_placed=(*result.not_placed, *lost), findings=findings,
        report={
            **result.report,
            "findings": finding_report(findings),
            "objects": [r for r in result.report["objects"] if r["instance"] not in gone],
            "not_placed": [*result.report.get("not_placed", []), *missing_report(lost)],
            "rejected_places": {str(i): n for i, n in sorted(counts.items())},
        },
    )  # fmt: skip


def missing_report(missing: Sequence[NotPlaced]) -> list[dict[str, Any]]:
    """Return what was not placed, and why, as JSON values."""
    return [{"obj_id": n.obj_id, "instance": n.instance, "reason": n.reason} for n in missing]


def finding_report(findings: Sequence[Defect]) -> list[dict[str, Any]]:
    """Return what is wrong with views or with the scene, as JSON values."""
    return [{"kind": f.kind, "words": f.words} for f in findings]
