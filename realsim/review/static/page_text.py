"""The words of the static page."""

from typing import Any

import numpy as np

from realsim.records import GraspSet, ObjectModel, ObjectPose, Scene
from realsim.rendering.overlay import VERDICT_RGB
from realsim.review.content.content import SceneContent
from realsim.review.content.views import worst_first
from realsim.review.corrections import DECIDED, corrected_scene, decision_on
from realsim.review.journal import Entry, ReviewState
from realsim.review.placing.ellipsoid import pose_sigmas
from realsim.review.replaying.grasp_words import one_line
from realsim.review.scene_list import VERDICT_ORDER

NOT_KNOWN = "not known"


def counts_words(content: SceneContent, scene: Scene, state: ReviewState) -> str:
    """Return the line under the title: scene, verdicts, reviewers, views."""
    found = {v: sum(o.verdict == v for o in scene.objects) for v in VERDICT_ORDER}
    verdicts = ", ".join(f"{n} {v}" for v, n in found.items() if n)
    count = _counted(len(scene.objects), "object")
    words = [scene.name, f"{count}: {verdicts}" if verdicts else count]
    words.append(_counted(len(content.views), "view"))
    excluded = len(state.excluded_views())
    if excluded:
        words[-1] += f" ({excluded} left out by the reviewers)"
    names = sorted({one_line(e.reviewer) for e in state.standing})
    words.append(f"reviewed by {', '.join(names)}" if names else "not reviewed yet")
    return "; ".join(w for w in words if w) + "."


def object_rows(content: SceneContent, scene: Scene, state: ReviewState) -> list[dict[str, Any]]:
    """Return what the list says of the objects, worst first."""
    corrected = corrected_scene(content.scene, state)
    sets = {g.instance: g for g in content.grasp_sets}
    rows: list[dict[str, Any]] = []
    for placed in worst_first(scene.objects):
        model, was = content.models[placed.obj_id], corrected.object(placed.instance)
        lines = [*_judged(was, decision_on(was, state)), *was.reasons]
        quotes = [
            (_said(e.comment), _said(f"{e.reviewer}, {e.time[:10]}"))
            for e in state.of(placed.instance)
            if e.comment.strip()
        ]
        rows.append({
            "instance": placed.instance, "name": _said(model.name), "verdict": placed.verdict,
            "color": "#{:02x}{:02x}{:02x}".format(*VERDICT_RGB[placed.verdict]),
            "lines": [_said(line) for line in lines], "quotes": quotes,
            "rows": _table(placed, was, model, sets.get(placed.instance)),
        })  # fmt: skip
    return rows


def _judged(corrected: ObjectPose, decision: Entry | None) -> list[str]:
    """Return who judged, and what the program had computed."""
    if decision is None:
        return [f"computed: {corrected.verdict}; judged by nobody"]
    said = f"{DECIDED[decision.action]} by {decision.reviewer}, {decision.time[:10]}"
    return [said, f"computed: {corrected.verdict}"]


def _table(
    placed: ObjectPose, corrected: ObjectPose, model: ObjectModel, grasps: GraspSet | None
) -> list[tuple[str, str]]:
    rows = [("instance", str(placed.instance)), ("object id", str(placed.obj_id))]
    rows += sigma_rows(corrected, model)
    agree = corrected.checks.get("agree")
    if agree is not None and np.isfinite(agree):
        rows.append(("pixels that agree with the depth", f"{100 * agree:.1f} %"))
    if grasps is not None and len(grasps):
        rows.append(("grasps, good of all", f"{int(grasps.good.sum())} of {len(grasps)}"))
    return rows


def sigma_rows(placed: ObjectPose, model: ObjectModel) -> list[tuple[str, str]]:
    """Return how sure position and turn are: words and figures."""
    sure = pose_sigmas(placed, model)
    if sure is None:
        return [("1 sigma of the pose", NOT_KNOWN)]
    rows = [("1 sigma, position", f"{1e3 * sure.position_m:.2g} mm")]
    if sure.sigmas_deg:
        rows.append(("1 sigma, turn", f"{max(sure.sigmas_deg):.2g} deg"))
    return rows


def _said(text: str) -> str:
    return one_line(text).strip()


def _counted(count: int, thing: str) -> str:
    return f"{count} {thing}" if count == 1 else f"{count} {thing}s"
