"""What was annotated, summed up over all views out of their annotations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from realsim.records import ObjectPose, Scene
from realsim_sim_bridge.annotation.inputs import FrameInputs

Parts = Mapping[int, Mapping[str, Any]]
MOST_NAMED = 8
"""Number of views that a message names."""
WORTH_TELLING = 0.005
"""Share of an object that must be hidden in a view for the view to be told."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectSummary:
    """One object over all views."""

    instance: int
    name: str
    verdict: str
    frames_seen: int
    """Views in which a pixel of it is visible."""
    mean_visibility: float
    """Mean of visib_fract over these views; NaN = none."""
    agreement: float
    """Share of the measured visible pixels that agree with the rendered depth; NaN = none."""
    hidden_by_unknown: float
    """Share of its rendered visible pixels that something hides which is not in the scene."""
    frames_hidden: int
    """Views in which that is so."""


@dataclass(frozen=True, kw_only=True, slots=True)
class AnnotationSummary:
    """What was annotated."""

    views: int
    """Views annotated, those of an earlier run included."""
    skipped: int
    """Views whose annotation of an earlier run still holds."""
    objects: tuple[int, ...]
    """Instances annotated, in the order of the masks."""
    left_out: tuple[int, ...]
    """Instances not annotated because they are rejected."""
    doubtful: tuple[int, ...]
    """Instances annotated and flagged: their verdict is not 'accepted'."""
    views_left_out: tuple[int, ...]
    """Views not annotated because the objects were not registered in them."""
    agreement: dict[int, float]
    """Per instance, the share of measured visible pixels that agree with the rendered depth, over
    all views; NaN = never seen with a measurement."""
    grasps: int
    """Grasps per view."""
    by_object: tuple[ObjectSummary, ...] = ()
    """The objects in the order of `objects`."""
    empty_views: tuple[int, ...] = ()
    """Views annotated in which no object is visible."""
    flagged_views: tuple[int, ...] = ()
    """Views that somebody should look at: pose or occluder, or a camera inside an object."""
    notes: tuple[str, ...] = ()
    """What was noticed, a sentence each."""

    def __str__(self) -> str:
        """Return one line for the terminal."""
        return self.told(f", {self.skipped} still held")

    def told(self, held: str = "") -> str:
        """Return one line: the same of every run that ends so, but for what is `held`."""
        shares = ", ".join(
            f"{i}: unknown" if np.isnan(a) else f"{i}: {100 * a:.0f} %"
            for i, a in self.agreement.items()
        )
        which = numbers(self.views_left_out)
        without = f", {len(self.views_left_out)} not registered ({which})" if which else ""
        empty = f", {len(self.empty_views)} without any object" if self.empty_views else ""
        aside = f"{held}{without}{empty}"[2:]
        return (
            f"{self.views} {'view' if self.views == 1 else 'views'} annotated"
            f"{f' ({aside})' if aside else ''}, "
            f"{len(self.objects)} objects ({len(self.doubtful)} not accepted, "
            f"{len(self.left_out)} rejected and left out), {self.grasps} grasps a view; "
            f"agreement with the depth {shares or 'unknown'}"
        )


def numbers(views: Sequence[int]) -> str:
    """Return numbers for a message, the first few of them."""
    return ", ".join(map(str, views[:MOST_NAMED])) + (", ..." if len(views) > MOST_NAMED else "")


def summary_of(
    scene: Scene, inputs: FrameInputs, parts: Parts, skipped: int, all_views: Sequence[int]
) -> AnnotationSummary:
    """Return the summary of all views.

    Args:
        scene: where the objects stand, rejected ones included.
        inputs: what was annotated.
        parts: view -> its annotation.
        skipped: views that were annotated already.
        all_views: every view of the session.
    """
    by_object = tuple(_object_summary(inputs, o, parts) for o in inputs.objects)
    empty = tuple(v for v, part in parts.items() if part["is_empty"])
    left_out = tuple(o.instance for o in scene.objects if o.verdict == "rejected")
    hides_nothing = (
        f"instance {numbers(left_out)} is rejected, so nothing hides behind it: masks of what "
        "stands there may be too large, unless the measured depth shows it.",
    )
    return AnnotationSummary(
        views=len(parts),
        skipped=skipped,
        objects=tuple(o.instance for o in inputs.objects),
        left_out=left_out,
        doubtful=tuple(o.instance for o in inputs.objects if o.verdict != "accepted"),
        views_left_out=tuple(v for v in all_views if v not in parts),
        agreement={o.instance: o.agreement for o in by_object},
        grasps=sum(len(g) for g in inputs.grasp_sets),
        by_object=by_object,
        empty_views=empty,
        flagged_views=tuple(v for v, part in parts.items() if _is_flagged(part)),
        notes=(*(hides_nothing if left_out else ()), *_notes(inputs, parts, empty)),
    )


def _object_summary(inputs: FrameInputs, placed: ObjectPose, parts: Parts) -> ObjectSummary:
    """Return one object's summary."""
    rows = [e for p in parts.values() for e in p["objects"] if e["instance"] == placed.instance]
    seen = [e["visib_fract"] for e in rows if e["px_count_visib"]]
    agreed = measured = 0.0
    for e in rows:
        share = e["depth"]["measured"]
        if share and e["depth"]["agree"] is not None:
            pixels = share * (e["px_count_visib"] + e["px_hidden_by_unknown"])
            measured += pixels
            agreed += pixels * e["depth"]["agree"]
    hidden = sum(e["px_hidden_by_unknown"] for e in rows)
    rendered = hidden + sum(e["px_count_visib"] for e in rows)
    return ObjectSummary(
        instance=placed.instance,
        name=inputs.models[placed.obj_id].name,
        verdict=placed.verdict,
        frames_seen=len(seen),
        mean_visibility=float(np.mean(seen)) if seen else float("nan"),
        agreement=agreed / measured if measured > 0 else float("nan"),
        hidden_by_unknown=hidden / rendered if rendered else 0.0,
        frames_hidden=sum(e["px_hidden_by_unknown"] > 0 for e in rows),
    )


def _is_flagged(part: Mapping[str, Any]) -> bool:
    """Return whether somebody should look at a view."""
    findings = [e["unknown_occluder"]["finding"] for e in part["objects"]]
    return "pose or occluder" in findings or bool(part["camera_inside"])


def _notes(inputs: FrameInputs, parts: Parts, empty: Sequence[int]) -> tuple[str, ...]:
    """Return what was noticed, most serious first."""
    suspects: list[str] = []
    hidden: list[str] = []
    inside: list[str] = []
    for view, part in parts.items():
        names = {e["instance"]: e["name"] for e in part["objects"]}
        inside += [f"view {view}: the camera stands inside {names.get(i, i)}; its mask shows the "
                   "inner walls." for i in part["camera_inside"]]  # fmt: skip
        for e in part["objects"]:
            u = e["unknown_occluder"]
            share = f"{100 * u['share']:.0f} % of {e['name']}"
            if u["finding"] == "pose or occluder":
                what = "taken out of its mask" if u["is_removed"] else "left in its mask"
                gap = f"{1e3 * u['gap_m']:.0f} mm nearer" if u["gap_m"] is not None else "nearer"
                suspects.append(
                    f"view {view}: pose or occluder: {share} is measured {gap} than its model; "
                    f"{what}. Look at the picture."
                )
            elif u["finding"] == "occluder" and u["share"] >= WORTH_TELLING:
                hidden.append(
                    f"view {view}: {share} is hidden by something that is not in the scene"
                )
    notes = [*inside, *suspects, *hidden]
    if empty:
        what = "view shows" if len(empty) == 1 else "views show"
        notes.append(f"{len(empty)} {what} no object: {numbers(empty)}.")
    without_ray = max((part["px_without_ray"] for part in parts.values()), default=0)
    if without_ray:
        share = 100 * without_ray / (inputs.intrinsics.width * inputs.intrinsics.height)
        notes.append(
            f"{without_ray} pixels ({share:.2f} %) of every view carry no label: the lens model "
            "cannot be inverted there. Calibrate with views that fill the corners of the image."
        )
    return tuple(notes)
