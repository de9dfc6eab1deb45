"""The corners of all views, checked and put together; outliers among them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.errors import InputError
from realsim.geometry.robust import MAD_TO_SIGMA
from realsim.records import CameraIntrinsics, Target
from realsim_calibration.lens.bundle import LensFit, Observations
from realsim_calibration.lens.start import is_line
from realsim_calibration.views import TargetDetection

NAMED = 6
"""Views that a message names before it says how many more there are."""
OUTSIDE_PX = 2.0
"""Corners may lie this far outside the image [px]: detectors extrapolate a little."""


LEAST_CORNERS = 6
"""Corners a view needs: a pose takes three, and with few more it says nothing of the lens."""
CORNER_SIGMAS = 6.0
"""A corner further off than this many sigmas is left out: of a million good ones none is."""
LEAST_CORNER_PX = 0.3
"""A corner nearer than this is never left out [px]: it does no harm."""
VIEW_RATIO = 5.0
"""A view whose median error is more than this times the median view's is left out."""
LEAST_VIEW_PX = 1.0
"""A view with a smaller median error is never left out [px]."""
ROUNDS = 3
"""Rounds of leaving out and fitting again."""
WEIGHT_RATIO = 16.0
"""Predicted variances of corners may differ by this factor; detectors' predictions are not
trusted further."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Corners:
    """The corners in use, and what became of the others."""

    obs: Observations
    indices: Int64
    """(views in use,) their places in the list that was given."""
    ids: Int64
    """(N,) points of the target."""
    middle: Array
    """(2,) the board's middle on the drawing [m]."""
    names: tuple[str, ...]
    """Names of all views given."""
    reasons: tuple[str, ...]
    """Reasons of all views given: why they are not in use, empty where they are."""
    outliers: dict[int, tuple[tuple[int, float], ...]]
    """Corners left out of every view: (point, distance [px])."""

    def name_of(self, view: int) -> str:
        """Return the name of a view in use."""
        return self.names[int(self.indices[view])]

    def without(self, views: Mask, reason: str) -> "Corners":
        """Return the corners without the views of a mask (views in use,), for a reason."""
        reasons = list(self.reasons)
        for i in self.indices[views]:
            reasons[int(i)] = reason
        return replace(
            self,
            obs=self.obs.only_views(~views),
            ids=self.ids[~views[self.obs.view]],
            indices=self.indices[~views],
            reasons=tuple(reasons),
        )


def named(names: Sequence[str], most: int = NAMED) -> str:
    """Return a few names for a message."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def gather(
    detections: Sequence[TargetDetection],
    target: Target,
    names: Sequence[str] | None,
    start: CameraIntrinsics | None,
) -> Corners:
    """Return the corners of all views that have enough of them.

    Raises:
        InputError: there are no views, names do not match, image sizes differ among the views or
            from the start's, points lie outside the image or not on the target.
    """
    if len(detections) == 0:
        raise InputError("camera fit: no views were given; 10 to 40 of them are usual.")
    labels = tuple(str(i) for i in range(len(detections))) if names is None else tuple(names)
    if len(labels) != len(detections):
        raise InputError(f"camera fit: {len(labels)} names for {len(detections)} views.")
    size = _image_size(detections, labels, start)
    drawing = target.points_board[:, :2]
    middle = (drawing.min(0) + drawing.max(0)) / 2
    reasons: list[str] = []
    used: list[int] = []
    for i, (d, label) in enumerate(zip(detections, labels, strict=True)):
        _check_points(d, label, size, target)
        reason = ""
        if len(d) < LEAST_CORNERS:
            reason = f"{len(d)} corners, {LEAST_CORNERS} are needed"
        elif is_line(drawing[d.point_ids]) or is_line(d.uv):
            reason = "its corners lie on one line"
        reasons.append(reason)
        if not reason:
            used.append(i)
    parts = [detections[i] for i in used]
    ids = np.concatenate([np.zeros(0, np.int64), *(d.point_ids for d in parts)])
    obs = Observations(
        flat=drawing[ids] - middle,
        uv=np.concatenate([np.zeros((0, 2)), *(d.uv for d in parts)]),
        weight=_weights(parts, WEIGHT_RATIO),
        offsets=np.cumsum([0, *(len(d) for d in parts)]).astype(np.int64),
        half_extent_m=float(np.ptp(drawing, axis=0).max()) / 2,
        image_size=size,
    )
    return Corners(
        obs=obs, indices=np.array(used, dtype=np.int64), ids=ids, middle=middle,
        names=labels,
        reasons=tuple(reasons), outliers={},
    )  # fmt: skip


def _image_size(
    detections: Sequence[TargetDetection], labels: Sequence[str], start: CameraIntrinsics | None
) -> tuple[int, int]:
    """Return the image size that all views share.

    Raises:
        InputError: they do not, or the start has another.
    """
    sizes = [(int(d.image_size[0]), int(d.image_size[1])) for d in detections]
    if start is not None:
        usual = (start.width, start.height)
    else:
        usual = max(dict.fromkeys(sizes), key=sizes.count)
    odd = [f"{n} ({s[0]}x{s[1]})" for n, s in zip(labels, sizes, strict=True) if s != usual]
    if odd:
        whose = "the given intrinsics are for" if start is not None else "most views are"
        raise InputError(
            f"camera fit: {whose} {usual[0]}x{usual[1]} px, but not {named(odd)}. One lens is "
            "calibrated at one image size: take the views that differ out, or scale the intrinsics."
        )
    if min(usual) < 1:
        raise InputError(f"camera fit: the image size {usual[0]}x{usual[1]} is not positive.")
    return usual


def _check_points(d: TargetDetection, label: str, size: tuple[int, int], target: Target) -> None:
    """Raise unless a view's points are on the target and in the image."""
    d.points(target)
    if len(d) == 0:
        return
    low, high = d.uv.min(0), d.uv.max(0)
    if np.any(low < -OUTSIDE_PX) or np.any(high > np.array(size) - 1 + OUTSIDE_PX):
        raise InputError(
            f"camera fit: view {label} has corners from ({low[0]:.0f}, {low[1]:.0f}) to "
            f"({high[0]:.0f}, {high[1]:.0f}), outside its image of {size[0]}x{size[1]} px. Were "
            "they found in an image of another size?"
        )
    if d.sd_px is not None and not (np.all(np.isfinite(d.sd_px)) and np.all(d.sd_px > 0)):
        raise InputError(
            f"camera fit: view {label} has predicted sigmas that are not positive pixels; leave "
            "`sd_px` None where nothing is predicted."
        )


def _weights(parts: Sequence[TargetDetection], ratio: float) -> Array:
    """Return relative inverse variances (N,) of median 1; 1 where a view predicts none."""
    predicted = [d.sd_px for d in parts if d.sd_px is not None]
    if not predicted:
        return np.ones(sum(len(d) for d in parts))
    usual = float(np.median(np.concatenate(predicted)))
    sds = [np.full(len(d), usual) if d.sd_px is None else d.sd_px for d in parts]
    weight = (usual / np.concatenate(sds)) ** 2
    return np.clip(weight, 1 / ratio, ratio)


def find_outliers(corners: Corners, fit: LensFit) -> tuple[Corners | None, Mask]:
    """Return the corners without outliers (None = there are none), and the views kept (views,).

    A corner is judged by the scatter of all corners or, where that is larger, by its own view's: a
    blurred view is not a heap of outliers.
    """
    obs = corners.obs
    distance = np.linalg.norm(fit.residuals, axis=-1)
    scaled = np.abs(fit.residuals) * np.sqrt(obs.weight)[:, None]
    everyone = MAD_TO_SIGMA * float(np.median(scaled))
    cuts = list(zip(obs.offsets[:-1], obs.offsets[1:], strict=True))
    own = np.array([MAD_TO_SIGMA * float(np.median(scaled[a:b])) for a, b in cuts])
    view_px = np.array([float(np.median(distance[a:b])) for a, b in cuts])
    limit_px = max(VIEW_RATIO * float(np.median(view_px)), LEAST_VIEW_PX)
    keep_view = view_px <= limit_px
    allowed = CORNER_SIGMAS * np.maximum(own, everyone)[obs.view] / np.sqrt(obs.weight)
    keep = distance <= np.maximum(allowed, LEAST_CORNER_PX)
    left = np.bincount(obs.view[keep], minlength=obs.views)
    thin = keep_view & (left < LEAST_CORNERS)
    if keep_view.all() and keep.all():
        return None, keep_view
    reasons, outliers = list(corners.reasons), dict(corners.outliers)
    for k, (a, b) in enumerate(cuts):
        i = int(corners.indices[k])
        if not keep_view[k]:
            reasons[i] = (
                f"its corners are {view_px[k]:.1f} px off (median), other views' "
                f"{float(np.median(view_px)):.2f} px: wrongly found, or the board moved"
            )
        elif thin[k]:
            reasons[i] = f"{left[k]} corners are left without its outliers"
        else:
            bad = [int(n) for n in range(a, b) if not keep[n]]
            gone = tuple((int(corners.ids[n]), float(distance[n])) for n in bad)
            outliers[i] = outliers.get(i, ()) + gone
    keep_view = keep_view & ~thin
    cut = obs.only_corners(keep)
    stay = keep_view[cut.view]
    return (
        replace(
            corners,
            obs=cut.only_views(keep_view),
            ids=corners.ids[keep][stay],
            indices=corners.indices[keep_view],
            reasons=tuple(reasons),
            outliers=outliers,
        ),
        keep_view,
    )
