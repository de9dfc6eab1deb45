"""Whether a scale may be trusted, judged without ground truth, and what limits it.

Does a scale and pose explain what the cameras measured? Rendered and compared, without truth.

Every ray of every view has a measured depth m and a rendered one z (the mesh or the table, what is
nearer). With l = max(-1, 1 - 2 ((m - z) / tau)^2) the gain is
    sum [l(mesh and table) - l(table alone)]  /  sum over the object's rays of [1 - l(table alone)]:
1 = every ray that met the object is explained and none that passed it is blocked; 0 = no better
than an empty table; negative = the mesh stands where the cameras looked through. Both a mesh that
is too large and one that is too small lose, which no distance of points to a surface can say.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.records import SupportPlane, Verdict
from realsim.registration.table_planes import table_depth
from realsim.rendering.rays import rotated
from realsim.scanning.scale.config import ScaleConfig
from realsim.scanning.scale.evidence import LEAST_HEIGHT_M, ScanEvidence, ScanView
from realsim.scanning.scale.joint import Outlook
from realsim.scanning.scale.result import Limit
from realsim.scanning.scale.shape import ScanShape
from realsim.scanning.scale.state import SIZE, ScaleState, claimed_cameras

TAU_M = 0.003
"""Depth difference that agrees whatever the noise [m]."""
TAU_SHAPE = 0.02
"""Plus, in the square, this share of the size: generated meshes are off by as much."""
TAU_SIGMAS = 1.5
"""Plus so many sigma of the depth."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Explained:
    """How well a state explains some views."""

    gain: float
    """Share of the object that is explained, see above."""
    agree: float
    """Share of the rays that meet the model and were measured whose depth agrees."""
    cover: float
    """Share of the rays that met the object whose depth agrees."""
    iou: float
    """Overlap of the rendered and the measured mask, over the rays that were measured."""
    view_agree: Array
    """(V,) agree of every view."""
    view_iou: Array
    """(V,) overlap of every view."""


def explain(
    shape: ScanShape,
    evidence: ScanEvidence,
    state: ScaleState,
    *,
    views: int | None = None,
    every: int = 1,
) -> Explained:
    """Return how well scale, pose and cameras explain the measured depth.

    Args:
        shape: the mesh.
        evidence: what was measured.
        state: scale, pose, cameras, table.
        views: only so many of the views, spread evenly; None = all.
        every: only every so many of their rays.
    """
    n = len(evidence.views)
    chosen = np.arange(n)
    if views is not None and views < n:
        chosen = np.unique(np.linspace(0, n - 1, views).round().astype(int))
    cameras = state.cameras(claimed_cameras(evidence.views))
    rows = [
        _one_view(shape, evidence, state, (evidence.views[k], cameras[k]), every) for k in chosen
    ]
    sums = np.array(rows)
    total = sums.sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return Explained(
            gain=float(total[0] / max(total[1], 1e-9)),
            agree=float(total[2] / max(total[3], 1.0)),
            cover=float(total[4] / max(total[5], 1.0)),
            iou=float(total[6] / max(total[7], 1.0)),
            view_agree=sums[:, 2] / np.maximum(sums[:, 3], 1.0),
            view_iou=sums[:, 6] / np.maximum(sums[:, 7], 1.0),
        )


def tolerance(evidence: ScanEvidence, depth: Array) -> Array:
    """Return the depth difference that agrees (N,) at depths (N,) [m]."""
    constant = np.hypot(TAU_M, TAU_SHAPE * evidence.size_m)
    return constant + TAU_SIGMAS * evidence.noise.sigma(depth)


def _one_view(
    shape: ScanShape,
    evidence: ScanEvidence,
    state: ScaleState,
    view: tuple[ScanView, Array],
    every: int,
) -> tuple[float, ...]:
    """Return the sums of one view, every ray counting as the pixels that it stands for."""
    seen, T = view
    rays, depth = seen.rays[::every], seen.depth[::every]
    on_object = seen.is_object[::every]
    directions = rotated(rays, T[:3, :3])
    hit = shape.cast(T[:3, 3], directions, state.s, state.R, state.t).astype(np.float64)
    plane = SupportPlane(T_world_table=state.table)
    table = np.minimum(table_depth(plane, T, rays.astype(np.float64)), 1e3)
    model = hit < table
    # So near to the table measured points are not told from it: an open vessel's floor.
    origin = state.table[:3, 3]
    up = state.table[:3, 2]
    height = (T[:3, 3] - origin) @ up + np.where(model, hit, 0.0) * (directions @ up)
    z = np.minimum(hit, table)
    known = depth > 0
    m = state.corrected(rays * depth[:, None], 0)[:, 2]
    tau = tolerance(evidence, np.where(known, depth, 1.0))
    new = np.maximum(-1.0, 1.0 - 2.0 * np.square((m - z) / tau))
    old = np.maximum(-1.0, 1.0 - 2.0 * np.square((m - table) / tau))
    agrees = np.abs(m - z) < tau
    tall = model & (height > LEAST_HEIGHT_M + 3.0 * evidence.noise.sigma(np.where(known, m, 0.0)))
    area = seen.ray_area_px * every
    best = known & on_object
    return tuple(
        area * float(x)
        for x in (
            np.sum((new - old)[known]),
            np.sum((1.0 - old)[best]),
            np.count_nonzero(known & model & agrees),
            np.count_nonzero(known & model),
            np.count_nonzero(best & agrees & model),
            np.count_nonzero(best),
            np.count_nonzero(best & model),
            np.count_nonzero(known & (tall | on_object)),
        )
    )


# --- the verdict ---------------------------------------------------------------------------------


OFFSET_M = 0.0002
"""An offset of the surface that nothing in a session shows [m]: gloss, translucency, powder."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Judged:
    """A verdict with its reasons."""

    verdict: Verdict
    reasons: tuple[str, ...]
    checks: dict[str, float]
    notes: tuple[str, ...] = ()


def judge(
    shape: ScanShape,
    evidence: ScanEvidence,
    fit: tuple[ScaleState, Outlook, Explained],
    rivals: Sequence[tuple[float, float]],
    rules: tuple[float, ScaleConfig],
) -> Judged:
    """Return the verdict on a fit.

    Args:
        shape: the mesh.
        evidence: what was measured.
        fit: state, what the fit saw, and how well it explains the images.
        rivals: scale and gain of other solutions.
        rules: 1-sigma of the log scale, and the constants.
    """
    (state, look, seen), (sigma, config) = fit, rules
    v = config.verdict
    # A rival that ended at the same scale is none.
    scale = state.s * shape.unit
    others = [(s, gain) for s, gain in rivals if abs(np.log(s / scale)) > v.rival_change]
    checks = {
        "far": _share_far(look, evidence, config), "gain": seen.gain, "agree": seen.agree,
        "cover": seen.cover, "iou": seen.iou,
        "contrast": min((seen.gain - gain for _, gain in others), default=1.0),
        "shape_mm": 1e3 * look.shape.sigma_m, "shape_share": _shape_share(look, evidence),
        "sigma_percent": 100 * sigma, "rim_px": state.rim, "bias_per_m": state.bias_per_m,
    }  # fmt: skip
    wrong = _refusals(checks, config)
    doubts = [*_doubts_of_object(checks, evidence, config), *_doubts_of_scale(checks, config)]
    doubts += [
        f"a pose with a scale {100 * (other / scale - 1):+.1f} % off explains the images as well "
        f"({gain:.2f} against {seen.gain:.2f}); give a start or a measured length."
        for other, gain in others
        if gain > seen.gain - v.rival_gain
    ]
    verdict: Verdict = "rejected" if wrong else "doubtful" if doubts else "accepted"
    return Judged(verdict=verdict, reasons=(*wrong, *doubts), checks=checks)


def _share_far(look: Outlook, evidence: ScanEvidence, config: ScaleConfig) -> float:
    """Return the share of the object's points that are too far from the mesh to be of it."""
    known = np.abs(look.residuals[np.isfinite(look.residuals)])
    return float(np.mean(known > config.verdict.far_share * evidence.size_m)) if len(known) else 1.0


def _shape_share(look: Outlook, evidence: ScanEvidence) -> float:
    """Return the RMS offset of the surface where it was measured, as a share of the size."""
    offsets = look.offsets[look.offset_sigmas < 2.0 * np.median(look.offset_sigmas)]
    return float(np.sqrt(np.mean(np.square(offsets))) / evidence.size_m)


def _refusals(checks: dict[str, float], config: ScaleConfig) -> list[str]:
    """Return why the result is rejected."""
    v, gain = config.verdict, checks["gain"]
    if gain >= v.reject_gain:
        return []
    return [
        f"the mesh explains {100 * gain:.0f} % of what was measured of the object (what it "
        f"contradicts deducted); {100 * v.least_gain:.0f} % and more are trusted. It is not this "
        "object, or mirrored, or was not found."
    ]


def _doubts_of_object(
    checks: dict[str, float], evidence: ScanEvidence, config: ScaleConfig
) -> Iterator[str]:
    """Yield why the mesh may not be of what stands there."""
    v = config.verdict
    if v.reject_gain <= checks["gain"] < v.least_gain:
        yield (
            f"the mesh explains {100 * checks['gain']:.0f} % of what was measured of the object; "
            f"{100 * v.least_gain:.0f} % and more are trusted."
        )
    if checks["iou"] < v.least_iou:
        yield (
            f"its outline overlaps the measured one by {100 * checks['iou']:.0f} %; "
            f"{100 * v.least_iou:.0f} % and more are trusted."
        )
    if checks["agree"] > v.part_agree and checks["cover"] < v.part_cover:
        yield (
            f"the mesh agrees where it is seen ({100 * checks['agree']:.0f} %) but covers "
            f"{100 * checks['cover']:.0f} % of what stands there: another object touches it, or "
            "the mesh is of a part only. Capture the object alone."
        )
    if checks["far"] > v.most_far:
        yield (
            f"{100 * checks['far']:.1f} % of the measured points lie more than "
            f"{1e3 * v.far_share * evidence.size_m:.0f} mm from the mesh; of the same object at "
            f"most {100 * v.most_far:.0f} % do. A part of it is elsewhere: another object of its "
            "kind?"
        )


def _doubts_of_scale(checks: dict[str, float], config: ScaleConfig) -> Iterator[str]:
    """Yield why the scale may not be known well enough."""
    v = config.verdict
    if checks["shape_share"] > v.worst_shape:
        yield (
            f"the surfaces differ by {100 * checks['shape_share']:.1f} % of the size; meshes of "
            f"the same object differ by less than {100 * v.worst_shape:.0f} %."
        )
    if checks["sigma_percent"] > 100 * v.doubtful_sigma:
        yield (
            f"the scale is known to {checks['sigma_percent']:.1f} % only; "
            f"{100 * v.doubtful_sigma:.1f} % and less are trusted. More views from other sides "
            "help."
        )


def sigma_log(look: Outlook, config: ScaleConfig) -> float:
    """Return the 1-sigma of the log scale.

    The part that the shape's error contributes is multiplied by `shape.trust`.
    """
    total = float(look.covariance[SIZE, SIZE])
    shape = max(total - look.without["shape"], 0.0)
    return float(np.sqrt(total - shape + config.shape.trust**2 * shape))


def limits_of(
    look: Outlook, evidence: ScanEvidence, state: ScaleState, config: ScaleConfig
) -> tuple[Limit, ...]:
    """Return what limits the scale, worst first."""
    total = float(look.covariance[SIZE, SIZE])

    def share(name: str) -> float:
        return 100.0 * float(np.sqrt(max(total - look.without[name], 0.0)))

    shape_mm = 1e3 * look.shape.sigma_m
    size_mm = 1e3 * evidence.size_m
    shift, turn = (
        1e3 * float(np.linalg.norm(state.hand_eye[3:])),
        float(np.degrees(np.linalg.norm(state.hand_eye[:3]))),
    )
    rows = [
        Limit(
            name="shape", percent=config.shape.trust * share("shape"),
            text=f"the mesh's shape is off by about {shape_mm:.2f} mm, "
            f"{100 * shape_mm / size_mm:.1f} % of its size; a better mesh would help, more views "
            "would not.",
        ),
        Limit(
            name="hand-eye", percent=share("hand-eye"),
            text=f"the hand-eye was moved by {shift:.2f} mm and {turn:.3f} deg to fit table and "
            "object; what is left of its error changes the scale.",
        ),
        Limit(
            name="arm", percent=share("arm"),
            text="each robot pose has an error of its own; more views average it.",
        ),
        Limit(
            name="depth bias", percent=share("bias"),
            text="a constant error of the disparity moves all surfaces; measure it with a board "
            "(`realsim calibrate` does).",
        ),
        Limit(
            name="outline", percent=share("outline"),
            text=f"outlines in depth images lie {state.rim:+.2f} px off; by how much is estimated.",
        ),
        Limit(
            name="depth noise", percent=100.0 * float(np.sqrt(look.without["all"])),
            text="noise of the depth; more views or a shorter distance average it.",
        ),
        Limit(
            name="surface offset", percent=100.0 * 2.0 * OFFSET_M / evidence.size_m,
            text=f"not in the sigma: a surface measured {1e3 * OFFSET_M:.1f} mm off (gloss, "
            f"translucency) changes the scale by 2 x {1e3 * OFFSET_M:.1f} mm / {size_mm:.0f} mm.",
        ),
    ]  # fmt: skip
    # What is not in the sigma comes last, however large.
    return (*sorted(rows[:-1], key=lambda r: -r.percent), rows[-1])
