"""What becomes of an annotation: kept, improved, or its replacement rejected, and by what evidence.

An annotation is replaced only where the new pose is better on the depth AND on the photograph, each
by a paired t-test: over blocks of the pixels that either pose claims, and over sectors of the two
outlines. The photograph is no part of the fit; where a pose was shifted onto it, that was done on
other squares of it. All other things stand meanwhile where they are believed to be.

A thing of which little is seen keeps its annotation; a pose that moved far must win clearly.

A new pose is no more than an estimate with a covariance C, and so is the annotation: its own error,
a in all directions, is told from the twist x between the two by x' (C + a^2 I)^-1 x = 6. What is
proposed is the mean of both by their weights (empirical Bayes): where the new pose is unsure, such
as a can's turn about its axis, the annotation stands. No evidence of one view tells whether its
whole depth is off; that is in C, too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.optimize import brentq

from realsim.arrays import Array, Array32, Mask
from realsim.geometry import camera, se3
from realsim.geometry.metrics import aligned_pose, mssd_symmetric
from realsim.records import ObjectModel, ObjectPose, SupportPlane
from realsim.registration.compare import Comparer, make_comparer
from realsim.registration.evidence import DepthFrame, EvidenceConfig, measure_noise
from realsim.registration.photo import (
    SQUARE_PX,
    Outline,
    Picture,
    hidden_by_measured,
    outline_of,
    shifted,
)

Kind = Literal["kept", "improved", "rejected"]

SAME_M = 0.0005
"""Poses nearer than this are the same [m]."""
FAR_M = 0.015
"""A pose that moved further is a proposal and must win clearly [m]."""
DEPTH_T = 3.0
"""Standard errors by which a new pose must be better on depth."""
FAR_DEPTH_T = 6.0
"""Standard errors by which a proposal must be better on depth."""
PHOTO_T = 3.0
"""Standard errors by which a new pose must be better on the photograph, half of it used."""
PHOTO_RATIO = 0.85
"""Greatest ratio of the mean distance from the photograph's edges to the annotation's; the
square of it for a proposal."""
LEAST_VISIBLE = 0.3
"""Visible share, at either pose, below which an object keeps its annotation."""
FAR_VISIBLE = 0.5
"""The same share for an object that is to move far."""
FAR_AGREE = 0.15
"""Share of its pixels by which more must agree with the depth where it moves far."""
WRONG_AGREE = 0.4
"""An annotation with which less of the depth agrees looks wrong itself."""
BLOCK_PX = 12
"""Blocks of pixels whose depth counts as one piece: noise and holes are correlated."""
SECTORS = 36
"""Sectors of an outline, each one piece."""
CAP_PX = 3.0
"""An edge further away, or none, counts as this [px]."""
RAY_SHARE = 0.005
"""1-sigma of one view's whole depth, as a share of the distance: data sheets of depth cameras
state limits of 1 to 2 %."""
LEAST_PIECES = 8
"""Fewer pieces decide nothing."""
VIEWS = 6
"""Views that are looked at, at most."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Evidence:
    """What speaks for a new pose against the annotation."""

    depth_t: float
    """Standard errors by which the new pose is better on depth; NaN = cannot be told."""
    photo_t: float
    """The same on the photograph."""
    photo_ratio: float
    """Mean square distance of the photograph's edges, new by old."""
    agree: tuple[float, float]
    """Share of the pixels in sight that agree with the depth: annotation, new pose."""
    edge_px: tuple[float, float]
    """Median distance of the photograph's edges [px]: annotation, new pose."""
    visible: float
    """Share of the thing that is in sight, the lesser of the two poses'."""
    moved_m: float
    """Maximum symmetry-aware surface distance of the two [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Outcome:
    """What became of one annotation."""

    instance: int
    kind: Kind
    words: str
    T_world_obj: Array
    """(4, 4) the pose to go on with."""
    evidence: Evidence | None
    """Evidence of the new pose; None = there is none."""
    T_proposed: Array | None = None
    """(4, 4) the pose that was refused or not better; None = there is none."""
    looks_wrong: bool = False
    """Whether the annotation that was kept does not fit what was measured."""

    def as_json(self) -> dict[str, Any]:
        """Return plain values for tables."""
        out: dict[str, Any] = {"outcome": self.kind, "why": self.words}
        if self.T_proposed is not None:
            out["T_world_obj_proposed"] = self.T_proposed.tolist()
        if (e := self.evidence) is not None:
            out |= {
                "depth_t": _plain(e.depth_t), "photo_t": _plain(e.photo_t),
                "agree_annotation": _plain(e.agree[0]), "agree_new": _plain(e.agree[1]),
                "edge_px_annotation": _plain(e.edge_px[0]), "edge_px_new": _plain(e.edge_px[1]),
                "visible": _plain(e.visible), "proposed_mm": _plain(1e3 * e.moved_m),
            }  # fmt: skip
        return out


@dataclass(frozen=True, eq=False, slots=True)
class _Proposal:
    """A pose that might take an annotation's place."""

    T_world_obj: Array
    on_photo: bool = False
    """Whether it was shifted onto the photograph."""
    words: str = ""
    """How much of the new pose it is."""


@dataclass(frozen=True, eq=False, slots=True)
class _Claim:
    """One thing at one pose in one view, all others at theirs."""

    own: Array32
    scene: Array
    """(H, W) depth of everything together [m]; inf = nothing is known to be there."""
    sight: Mask
    """(H, W) its pixels that nothing hides, rendered or measured."""
    visible: float
    outline: Outline


class Referee:
    """Compares poses of things in the views of a scene."""

    def __init__(
        self,
        pictures: Sequence[Picture],
        models: Mapping[int, ObjectModel],
        plane: SupportPlane | None,
    ) -> None:
        """Measure the depth's noise; `models` are by instance."""
        self.pictures, self.models = tuple(pictures), dict(models)
        frames = [
            DepthFrame(index=k, depth_m=p.depth_m, T_world_cam=p.T_world_cam)
            for k, p in enumerate(pictures)
        ]
        noise = measure_noise(frames, EvidenceConfig())
        intrinsics = pictures[0].intrinsics
        self._comparer: Comparer = make_comparer(intrinsics, frames, noise, plane)
        rows, columns = np.mgrid[: intrinsics.height, : intrinsics.width]
        shape, flat = rows.shape, (rows.ravel(), columns.ravel())
        self._tables = [self._comparer.table(f, *flat).reshape(shape) for f in frames]
        self._depths: dict[tuple[int, int, bytes], Array32] = {}

    def evidence(
        self, instance: int, T_old: Array, T_new: Array, others: Mapping[int, Array], held_out: bool
    ) -> Evidence:
        """Return what speaks for a new pose, the other things standing at their poses.

        `held_out`: of the photograph only the squares that no pose was shifted onto.
        """
        depth: list[Array] = []
        photo: list[Array] = []
        claims: list[tuple[_Claim, _Claim]] = []
        for v in range(len(self.pictures)):
            a, b = (self._claim(v, instance, T, others) for T in (T_old, T_new))
            claims.append((a, b))
            depth.append(self._depth_gains(v, a, b))
            photo.append(self._photo_costs(v, instance, T_old, a, b, held_out))
        costs = np.concatenate(photo)
        means = costs.mean(0) if len(costs) else np.full(2, np.nan)
        edges = [np.abs(np.concatenate([c[k].outline.offsets for c in claims])) for k in (0, 1)]
        old, new = (float(np.nanmedian(e)) if np.isfinite(e).any() else np.nan for e in edges)
        return Evidence(
            depth_t=_t(np.concatenate(depth)), photo_t=_t(costs @ [1.0, -1.0]),
            photo_ratio=float(means[1] / max(means[0], 1e-9)),
            agree=(self._agree([a for a, _ in claims]), self._agree([b for _, b in claims])),
            edge_px=(old, new),
            visible=min(max(c[k].visible for c in claims) for k in (0, 1)),
            moved_m=mssd_symmetric(T_old, T_new, self.models[instance]),
        )  # fmt: skip

    def _depth_of(self, v: int, instance: int, T: Array) -> Array32:
        key = (v, instance, T.tobytes())
        if key not in self._depths:
            self._depths[key] = self.pictures[v].depth_of(self.models[instance].mesh, T)
        return self._depths[key]

    def _claim(self, v: int, instance: int, T: Array, others: Mapping[int, Array]) -> _Claim:
        picture, own = self.pictures[v], self._depth_of(v, instance, T)
        rest = [self._depth_of(v, i, X) for i, X in others.items() if i != instance]
        behind = np.min([np.full_like(own, np.inf), *rest], axis=0)
        scene = np.minimum(np.minimum(own, behind), self._tables[v])
        hidden = hidden_by_measured(picture.depth_m, own)
        sight = np.isfinite(own) & (own <= behind) & ~hidden
        return _Claim(
            own, scene, sight, float(sight.sum() / max(np.isfinite(own).sum(), 1)),
            outline_of(picture, own, behind),
        )  # fmt: skip

    def _likelihood(self, v: int, scene: Array, where: Mask) -> Array:
        """Return how well the depth of pixels (N,) agrees, 1 to -1; 0 where nothing is known."""
        z, measured = scene[where], self.pictures[v].depth_m[where].astype(np.float64)
        agrees = self._comparer.likelihood(measured, np.minimum(z, 1e3))
        return np.where(np.isfinite(z), agrees, 0.0)

    def _gain(self, v: int, a: _Claim, b: _Claim, where: Mask) -> Array:
        """Return by how much the new pose is more likely at pixels (N,).

        Where one of the two has nothing known there, the other can only be contradicted.
        """
        old, new = (self._likelihood(v, c.scene, where) for c in (a, b))
        known = np.isfinite(a.scene[where]) & np.isfinite(b.scene[where])
        return np.where(known, new - old, np.minimum(new, 0.0) - np.minimum(old, 0.0))

    def _usable(self, v: int) -> Mask:
        return (self.pictures[v].depth_m > 0) & ~self._comparer.edges[v]

    def _depth_gains(self, v: int, a: _Claim, b: _Claim) -> Array:
        """Return (N,) by how much the new pose is more likely, block by block."""
        where = (a.sight | b.sight) & self._usable(v)
        gain = self._gain(v, a, b, where)
        i, j = (x // BLOCK_PX for x in np.nonzero(where))
        _, of = np.unique(i * 100_000 + j, return_inverse=True)
        return np.bincount(of.reshape(-1), weights=gain).astype(np.float64)

    def _photo_costs(
        self, v: int, instance: int, T: Array, a: _Claim, b: _Claim, held_out: bool
    ) -> Array:
        """Return (N, 2) mean distances of the edges, old and new, sector by sector."""
        picture = self.pictures[v]
        T_cam_obj = se3.invert(picture.T_world_cam) @ T
        middle = se3.transform(T_cam_obj, self.models[instance].mesh.bounds.mean(0)[None])
        center = camera.project(picture.intrinsics, middle)[0]
        sums: list[Array] = []
        counts: list[Array] = []
        for claim in (a, b):
            o = claim.outline
            if held_out:
                o = o.part(o.squares(SQUARE_PX, odd=True))
            d = np.minimum(np.nan_to_num(np.abs(o.offsets), nan=CAP_PX), CAP_PX)
            at, n = o.sectors(center, SECTORS), SECTORS
            sums.append(np.bincount(at, weights=d, minlength=n).astype(np.float64))
            counts.append(np.bincount(at, minlength=n).astype(np.float64))
        both = (counts[0] > 0) & (counts[1] > 0)
        return np.stack([s[both] / c[both] for s, c in zip(sums, counts, strict=True)], axis=1)

    def _agree(self, claims: Sequence[_Claim]) -> float:
        good, count = 0, 0
        for v, claim in enumerate(claims):
            likely = self._likelihood(v, claim.own.astype(float), claim.sight & self._usable(v))
            good, count = good + int(np.sum(likely > 0)), count + len(likely)
        return good / count if count else float("nan")


def decide(
    pictures: Sequence[Picture],
    models: Mapping[int, ObjectModel],
    annotations: Sequence[ObjectPose],
    registered: Sequence[ObjectPose],
    plane: SupportPlane | None,
) -> list[Outcome]:
    """Return what becomes of every annotation.

    Args:
        pictures: the views, with the cameras that `registered` is in.
        models: object id -> model.
        annotations: one per instance.
        registered: the new poses; an instance that is missing was not placed.
        plane: the table; None = not known.
    """
    of = {a.instance: models[a.obj_id] for a in annotations}
    referee = Referee(pictures, of, plane)
    new = {r.instance: r for r in registered if r.instance in of}
    now = {a.instance: a.T_world_obj for a in annotations}
    proposals = {i: [_Proposal(r.T_world_obj)] for i, r in new.items()}
    if len(pictures) == 1:
        # Several views were brought together by their depth; one can be laid onto its photograph.
        moved = shifted(
            pictures[0], [of[i].mesh for i in new], [r.T_world_obj for r in new.values()],
        )  # fmt: skip
        proposals = {
            i: [_Proposal(T, on_photo=True), *proposals[i]] for i, T in zip(new, moved, strict=True)
        }
    proposals = {
        i: [_fused(now[i], p, new[i], of[i], pictures) for p in given]
        for i, given in proposals.items()
    }
    outcomes: dict[int, Outcome] = {}
    for _ in range(2):  # the second time with the others where they now are
        for a in annotations:
            outcomes[a.instance] = _decided(
                a, new.get(a.instance), proposals.get(a.instance, ()), referee, now
            )
        now = {i: o.T_world_obj for i, o in outcomes.items()}
    return [outcomes[a.instance] for a in annotations]


def _fused(
    T_old: Array, p: _Proposal, found: ObjectPose, model: ObjectModel, pictures: Sequence[Picture]
) -> _Proposal:
    """Return a proposal together with the annotation, each as far as it is sure."""
    if found.covariance is None:
        return p
    # About the box's centre, turns times its radius: all six in metres of the surface.
    M = se3.from_translation(model.mesh.bounds.mean(0))
    radius = float(np.linalg.norm(np.ptp(model.mesh.bounds, axis=0))) / 2
    units = np.repeat([radius, 1.0], 3)
    new, old = p.T_world_obj @ M, aligned_pose(p.T_world_obj, T_old, model) @ M
    to_centre = units[:, None] * se3.adjoint(se3.invert(M))
    C = to_centre @ found.covariance @ to_centre.T
    if len(pictures) == 1:
        ray = new[:3, :3].T @ (new[:3, 3] - pictures[0].T_world_cam[:3, 3])
        C[3:, 3:] += RAY_SHARE**2 * np.outer(ray, ray)
    variances, axes = np.linalg.eigh(C)
    x = axes.T @ (units * se3.log(se3.invert(new) @ old))

    def surplus(own: float) -> float:
        return float(np.sum(x**2 / (variances + own))) - len(x)

    own = brentq(surplus, 0.0, float(x @ x)) if surplus(0.0) > 0 else 0.0
    back = axes @ (variances / (variances + own) * x)
    T = new @ se3.exp(back / units) @ se3.invert(M)
    taken, whole = (1e3 * mssd_symmetric(T_old, X, model) for X in (T, p.T_world_obj))
    return replace(p, T_world_obj=T, words=f"; {taken:.1f} of the fit's {whole:.1f} mm are sure")


def _decided(
    given: ObjectPose,
    found: ObjectPose | None,
    proposals: Sequence[_Proposal],
    referee: Referee,
    others: Mapping[int, Array],
) -> Outcome:
    """Return what becomes of one annotation."""
    T = given.T_world_obj
    if found is None:
        words = "it was not found again: its annotation is kept unchecked"
        return Outcome(instance=given.instance, kind="kept", words=words, T_world_obj=T,
                       evidence=None)  # fmt: skip
    first: tuple[Evidence, Kind, str, Array] | None = None
    for p in proposals:
        e = referee.evidence(given.instance, T, p.T_world_obj, others, p.on_photo)
        kind, words = _judged(e, found)
        words += p.words
        if kind == "improved":
            return Outcome(instance=given.instance, kind=kind, words=words,
                           T_world_obj=p.T_world_obj, evidence=e)  # fmt: skip
        first = first or (e, kind, words, p.T_world_obj)
    assert first is not None
    e, kind, words, T_proposed = first
    wrong = e.visible >= LEAST_VISIBLE and e.agree[0] < WRONG_AGREE
    if wrong:
        words += (
            f"; the annotation itself looks wrong: depth agrees at {100 * e.agree[0]:.0f} % of it"
        )
    return Outcome(instance=given.instance, kind=kind, words=words, T_world_obj=T, evidence=e,
                   T_proposed=T_proposed, looks_wrong=wrong)  # fmt: skip


def _judged(e: Evidence, found: ObjectPose) -> tuple[Kind, str]:
    """Return what becomes of an annotation by the evidence for a new pose, in words."""
    said = (
        f"depth agrees at {_share(e.agree[1])} instead of {_share(e.agree[0])} "
        f"(t {e.depth_t:.1f}), the photograph's edges at {e.edge_px[1]:.1f} instead of "
        f"{e.edge_px[0]:.1f} px (t {e.photo_t:.1f})"
    )
    far = e.moved_m > FAR_M
    if (why := _why_kept(e)) is not None:
        return "kept", why
    if found.verdict == "rejected":
        why = "; ".join(found.reasons) or "its checks failed"
        return "rejected", f"the new pose was refused: {why}"
    on_depth = e.depth_t > DEPTH_T
    ratio = PHOTO_RATIO
    if far:
        more = e.agree[1] - e.agree[0] >= FAR_AGREE
        on_depth, ratio = e.depth_t > FAR_DEPTH_T and more, ratio**2
    if on_depth and e.photo_t > PHOTO_T and e.photo_ratio < ratio:
        return "improved", said
    if far or e.depth_t < -DEPTH_T or e.photo_t < -PHOTO_T:
        way = f"{1e3 * e.moved_m:.0f} mm away, does not win clearly" if far else "is worse"
        return "rejected", f"the new pose, {way}: {said}" if far else f"the new pose {way}: {said}"
    sure = f"{DEPTH_T:g} and {PHOTO_T:g}"
    return "kept", f"the new pose is not surely better on both (t of {sure} would be): {said}"


def _why_kept(e: Evidence) -> str | None:
    """Return why a new pose is not even considered; None = it is."""
    if e.moved_m < SAME_M:
        return f"the new pose, where it is sure, is the same within {1e3 * SAME_M:g} mm"
    least = FAR_VISIBLE if e.moved_m > FAR_M else LEAST_VISIBLE
    if e.visible < least:
        return f"only {100 * e.visible:.0f} % of it is in sight"
    if np.isnan(e.depth_t) or np.isnan(e.photo_t):
        which = "depth" if np.isnan(e.depth_t) else "photograph"
        return f"the {which} shows too little of it to choose a pose by"
    return None


def _t(gains: Array) -> float:
    """Return by how many standard errors the mean of (N,) pieces is above 0; NaN = too few."""
    if len(gains) < LEAST_PIECES:
        return float("nan")
    return float(gains.mean() / max(np.std(gains, ddof=1) / np.sqrt(len(gains)), 1e-9))


def _share(value: float) -> str:
    return "-" if np.isnan(value) else f"{100 * value:.0f} %"


def _plain(value: float) -> float | None:
    return round(float(value), 3) if np.isfinite(value) else None
