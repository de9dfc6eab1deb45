"""Scale and pose of a mesh from the depth images of a session.

1. Evidence: the table, the one object on it, its points and outlines in every view.
2. Search: from a rough start or from none, to the few scales and poses that explain the images.
3. Joint fit of the best: scale, pose, cameras, table, biases and the error of the mesh's shape.
4. Views that speak against all others are left out, and the fit is done again.
5. Verdict without ground truth, and what limits the scale.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from realsim.arrays import Array, Mask
from realsim.errors import InputError
from realsim.records import CameraIntrinsics, Mesh, SupportPlane, Verdict
from realsim.registration.evidence import DepthFrame, check_frames, measure_noise
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.evidence import ScanEvidence, gather_scan
from realsim.scanning.scale.joint import Outlook, joint_fit, residual_per_vertex
from realsim.scanning.scale.result import ScaleFit, Similarity, ViewAgreement
from realsim.scanning.scale.search import Hypothesis, hypotheses, mirror_gain, to_given
from realsim.scanning.scale.shape import ScanShape, make_shape
from realsim.scanning.scale.state import SIMILARITY, ScaleState, priors_of
from realsim.scanning.scale.table import find_object, find_table
from realsim.scanning.scale.verdict import Explained, Judged, explain, judge, limits_of, sigma_log

__all__ = ["DepthFrame", "ScaleConfig", "ScaleFit", "Similarity", "fit_scale"]

Progress = Callable[[int, int], None]
LEAST_VIEWS = 3
"""Fewer views leave the scale to the shape of one side."""


def fit_scale(  # noqa: PLR0913 - keywords, each with a meaning of its own
    mesh: Mesh,
    intrinsics: CameraIntrinsics,
    frames: Sequence[DepthFrame],
    config: ScaleConfig | None = None,
    *,
    start: Similarity | None = None,
    plane: SupportPlane | None = None,
    at: tuple[float, float] | None = None,
    size_m: float | None = None,
    progress: Progress | None = None,
) -> ScaleFit:
    """Return the metric scale of a mesh, its pose, and whether they may be trusted.

    Args:
        mesh: the object in any unit and attitude; its shape may be off by some per cent.
        intrinsics: the camera of all frames.
        frames: depth images [m] with camera poses; three or more, from all around.
        config: settings.
        start: rough scale and pose (15 %, 10 mm, 10 deg); None = found from nothing.
        plane: the table, where it is known already; None = found.
        at: (x, y) in world [m] near the object, where several stand on the table.
        size_m: rough longest side of the object [m]; where several scales explain the images it
            says which is looked at.
        progress: called with (steps done, steps).

    Raises:
        InputError: fewer than three frames, images that are not the camera's, several objects.
        DegenerateError: no table, nothing on it, or a mesh without a body.
    """
    began = time.process_time()
    config = config or ScaleConfig()
    ordered = check_frames(frames, intrinsics)
    _require_views(len(ordered), "given")
    ticks = _Ticks(progress, len(ordered) + 4)
    shape = make_shape(mesh, config)
    evidence = _evidence(intrinsics, ordered, config, (plane, at), ticks)
    ticks.step()
    found = hypotheses(shape, evidence, start, config, size_m)
    ticks.step()
    state, look, seen, dropped = _joint(shape, evidence, found[0].state, config)
    ticks.step()
    first = _Fitted(found[0], state, look, explain(shape, seen, state))
    won, *others = _ranked(shape, seen, first, found[1:], config)
    state, look, explained = won.state, won.look, won.explained
    sigma = sigma_log(look, config)
    rivals = [(o.state.s * shape.unit, o.explained.gain) for o in others]
    judged = judge(shape, seen, (state, look, explained), rivals, (sigma, config))
    judged = _if_mirrored(shape, seen, (state, won.found.gain), judged, config)
    ticks.step()
    best = to_given(shape, state, explained.gain, won.found.source)
    return ScaleFit(
        scale=best.scale, sigma=best.scale * sigma, T_world_obj=best.T_world_obj,
        covariance=_covariance(look, sigma), verdict=judged.verdict, reasons=judged.reasons,
        checks=judged.checks, limits=limits_of(look, seen, state, config),
        views=_views(seen, (state, look, explained), dropped),
        residual_mm=residual_per_vertex(mesh, shape, look),
        plane=SupportPlane(
            T_world_table=state.table, rms_m=seen.plane.rms_m, inliers=seen.plane.inliers
        ),
        extent_mm=1e3 * best.scale * mesh.extent,
        candidates=tuple(
            to_given(shape, h.state, h.gain, h.source) for h in found[: config.search.compared]
        ),
        history=tuple(dict(h) for h in look.history), cpu_s=time.process_time() - began,
        notes=_notes(evidence, dropped, judged),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, slots=True)
class _Fitted:
    """A hypothesis fitted to the end."""

    found: Hypothesis
    state: ScaleState
    look: Outlook
    explained: Explained


class _Ticks:
    """Counts the steps for the progress callback."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._done, self._total = progress, 0, total

    def step(self, *_: int) -> None:
        """One more step is done, or one more view has been read."""
        self._done += 1
        if self._progress is not None:
            self._progress(min(self._done, self._total), self._total)


def _require_views(n: int, what: str) -> None:
    if n < LEAST_VIEWS:
        raise InputError(
            f"{n} views with depth and a camera pose were {what}; at least {LEAST_VIEWS} from "
            "different sides are needed for a scale, 12 or more all around are advised."
        )


def _evidence(
    intrinsics: CameraIntrinsics,
    frames: Sequence[DepthFrame],
    config: ScaleConfig,
    given: tuple[SupportPlane | None, tuple[float, float] | None],
    ticks: _Ticks,
) -> ScanEvidence:
    """Return what the frames measured of the object."""
    noise = measure_noise(frames, config.noise)
    plane = given[0] or find_table(intrinsics, frames, config.table, config.seed)
    footprint = find_object(intrinsics, frames, plane, noise, config.table, given[1])
    evidence = gather_scan(intrinsics, frames, (plane, footprint), noise, config, ticks.step)
    _require_views(len(evidence.views), f"left of {len(frames)}: the others do not see the object")
    return evidence


def _joint(
    shape: ScanShape, evidence: ScanEvidence, start: ScaleState, config: ScaleConfig
) -> tuple[ScaleState, Outlook, ScanEvidence, tuple[int, ...]]:
    """Return the joint fit, the evidence it used, and the numbers of the views left out."""
    state, look = joint_fit(shape, evidence, start, config)
    bad = _against_all(shape, evidence, state, config)
    if not bad.any() or np.count_nonzero(~bad) < LEAST_VIEWS:
        return state, look, evidence, ()
    dropped = tuple(v.index for v, b in zip(evidence.views, bad, strict=True) if b)
    kept = tuple(v for v, b in zip(evidence.views, bad, strict=True) if not b)
    fewer = replace(evidence, views=kept)
    again = replace(start, views=np.zeros((len(kept), 6)), hand_eye=np.zeros(6))
    state, look = joint_fit(shape, fewer, again, config)
    return state, look, fewer, dropped


def _against_all(
    shape: ScanShape, evidence: ScanEvidence, state: ScaleState, config: ScaleConfig
) -> Mask:
    """Return which views (V,) are out of line: their camera, or what they see of the object."""
    v = config.verdict
    twist = np.sqrt(np.mean(np.square(state.views / priors_of(config).arm), axis=1))
    iou = explain(shape, evidence, state, every=2).view_iou
    usual = float(np.median(iou))
    return (twist > v.view_sigmas) | (iou < v.view_share * usual)


def _ranked(
    shape: ScanShape,
    evidence: ScanEvidence,
    first: _Fitted,
    others: Sequence[Hypothesis],
    config: ScaleConfig,
) -> list[_Fitted]:
    """Return the first and the best other hypotheses of another scale, the best explanation first.

    The others are fitted to the end likewise: what looked worse before may be better then.
    """
    change = config.verdict.rival_change
    far = [h for h in others if abs(np.log(h.state.s / first.state.s)) > change]
    fitted = [first]
    for h in far[: config.search.rivals]:
        start = replace(h.state, views=np.zeros((len(evidence.views), 6)))
        state, look = joint_fit(shape, evidence, start, config)
        fitted.append(_Fitted(h, state, look, explain(shape, evidence, state)))
    return sorted(fitted, key=lambda f: -f.explained.gain)


def _if_mirrored(
    shape: ScanShape,
    evidence: ScanEvidence,
    fit: tuple[ScaleState, float],
    judged: Judged,
    config: ScaleConfig,
) -> Judged:
    """Return the verdict with the reason that the mesh is mirrored, if its mirror image fits.

    Args:
        shape: the mesh.
        evidence: what was measured.
        fit: the state, and how much the mesh explained after the coarse fit, as its mirror image's.
        judged: the verdict so far.
        config: settings.
    """
    (state, gain), c = fit, config.search
    if gain > c.sure_gain:
        return judged
    other = mirror_gain(shape, evidence, state, config)
    checks = judged.checks | {"mirrored_gain": other}
    if other < max(config.verdict.reject_gain, gain + c.mirror_gain):
        return replace(judged, checks=checks)
    reason = (
        f"its mirror image explains {100 * other:.0f} % of the object, the mesh itself "
        f"{100 * gain:.0f} %: the mesh is mirrored. Mirror it back (negate one coordinate and turn "
        "the faces over) and fit again."
    )
    verdict: Verdict = "doubtful" if judged.verdict == "accepted" else judged.verdict
    return replace(judged, verdict=verdict, reasons=(reason, *judged.reasons), checks=checks)


def _covariance(look: Outlook, sigma: float) -> Array:
    """Return the covariance (7, 7) of pose and log scale; all of it grows as the scale's part."""
    C = look.covariance[np.ix_(SIMILARITY, SIMILARITY)]
    return np.asarray(C * (sigma**2 / C[6, 6]), dtype=np.float64)


def _views(
    evidence: ScanEvidence, fit: tuple[ScaleState, Outlook, Explained], dropped: Sequence[int]
) -> tuple[ViewAgreement, ...]:
    """Return how every view agrees, in the order of their numbers."""
    state, look, explained = fit
    rows: list[ViewAgreement] = []
    for k, view in enumerate(evidence.views):
        mine = (look.view_of == k) & (look.kernels > 0)
        r = look.residuals[mine]
        twist = state.hand_eye + state.views[k]
        rows.append(
            ViewAgreement(
                index=view.index, points=int(np.count_nonzero(mine)),
                agree=float(explained.view_agree[k]), iou=float(explained.view_iou[k]),
                rms_mm=float(1e3 * np.sqrt(np.mean(np.square(r)))) if len(r) else float("nan"),
                shift_mm=float(1e3 * np.linalg.norm(twist[3:])),
                turn_deg=float(np.degrees(np.linalg.norm(twist[:3]))),
            )
        )  # fmt: skip
    nothing: dict[str, Any] = dict(
        points=0, agree=float("nan"), iou=float("nan"), rms_mm=float("nan"),
        shift_mm=float("nan"), turn_deg=float("nan"), used=False,
    )  # fmt: skip
    rows += [ViewAgreement(index=i, **nothing) for i in (*dropped, *evidence.unseen)]
    return tuple(sorted(rows, key=lambda r: r.index))


def _notes(evidence: ScanEvidence, dropped: Sequence[int], judged: Judged) -> tuple[str, ...]:
    """Return what a user should know besides."""
    notes = list(judged.notes)
    if dropped:
        named = ", ".join(map(str, dropped))
        notes.append(
            f"view {named} speaks against the others and was left out: its robot pose or its "
            "images are not what they should be."
        )
    if evidence.unseen:
        notes.append(f"view {', '.join(map(str, evidence.unseen))} does not see the object.")
    return tuple(notes)
