"""What is wrong with single views, or with all of them, named before anything is registered.

Every view is held against the others: how much it measured, where it alone sees the table, and
whether what stands on the table is where others see it (`held_views`). A view that fails is tried
at the other views' camera poses; when all fail, the usual mistakes are: poses inverted, axes of
another convention, another unit, images shifted against poses.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.geometry.robust import MAD_TO_SIGMA
from realsim.records import SupportPlane
from realsim.registration import view_agreement
from realsim.registration.body import Body
from realsim.registration.evidence import DepthNoise
from realsim.registration.find_table import ViewTable, view_table
from realsim.registration.view_agreement import Kind, ViewFinding
from realsim.registration.views import ViewPoints

LEVER_M = 0.1
"""A tilt moves the table by its tangent times this: half the width of what stands there [m]."""
LISTED = 12
"""At most so many views are listed in a sentence."""


LEAST_VIEW_POINTS = 50
"""Views with fewer trusted points are left out."""
LITTLE_SHARE = 0.25
"""A view with less than this share of the others' median depth pixels is named."""
TABLE_HEIGHT_M = 0.008
"""The table may be this far from where the others see it [m]: a hand-eye off by 1.5 mm and
0.4 deg moves it by 2 mm, forward kinematics by 1 mm."""
TABLE_TILT_DEG = 2.0
"""Greatest tilt of the table against what the others see [deg]: the same hand-eye tilts it by
0.6 deg."""
TABLE_SPREADS = 6.0
"""The same limits in median absolute deviations of the views, if that is more."""
TABLE_KEPT = 0.8
"""The common table holds less than this share of the points on the view's own: it is off."""
WORST_SHARE = 0.6
"""At first only views with this share of the worst one's contradictions are set aside."""
ROUNDS = 6
"""Views are held against sound ones only; which these are settles in 2 or 3 rounds."""
FOREIGN_SHARE = 0.30
"""More than this share of a view's points looked through by most others: another scene's, or
another pose's. Clean views: up to 0.015 (0.4 deg hand-eye); foreign ones: 0.5 to 1."""
PARTLY_SHARE = 0.10
"""More than this: something was moved, or the pose is off by a centimetre."""
SPREADS = 8.0
"""The same limit as median absolute deviations above the views' median, if that is more."""
SOLVED_SHARE = 0.3
"""Another pose explains a view if it leaves less than this share of its contradictions."""
OBJECT_REACH_M = 0.01
"""After registration: a point this far from every object is not explained [m]."""
OBJECT_SHARE = 0.35
"""A view with so much more of them than the median view does not fit the objects."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Odd:
    """A view that is not where the others are."""

    k: int
    """Its place among the held views."""
    share: float
    """Share of its points, and of its partners', that are looked through."""
    off: str
    """How its table lies against the others'; empty = it lies right, or is not seen."""


def check_views(
    views: Sequence[ViewPoints],
    plane: SupportPlane | None,
    noise: DepthNoise,
    *,
    bodies: Sequence[Body] = (),
    Ts_world_obj: Sequence[Array] = (),
) -> tuple[ViewFinding, ...]:
    """Return what is wrong with the views; a view without a finding is sound.

    Args:
        views: the trusted points of the views, where their cameras are said to be.
        plane: the table that they share, or None if none was found.
        noise: of the depth.
        bodies: the registered objects; only after registration.
        Ts_world_obj: per body (4, 4) its pose.

    Raises:
        InputError: there are no views, or as many poses as bodies were not given.
    """
    if not views:
        raise InputError("no views were given; at least one is needed.")
    if len(bodies) != len(Ts_world_obj):
        raise InputError(f"{len(bodies)} objects have {len(Ts_world_obj)} poses; one each.")
    found = _check_amounts(views)
    gone = {f.index for f in found if f.exclude}
    left = [v for v in views if v.index not in gone]
    if len(left) > 1:
        held = view_agreement.hold_views(left, plane, noise)
        wrong = view_agreement.check_all_poses(held, plane)
        if not wrong and plane is not None:
            wrong = _check_each(held, plane, noise)
        found += wrong
    if bodies and plane is not None:
        named = {f.index for f in found}
        rest = [v for v in left if v.index not in named]
        found += _check_objects(rest, plane, noise, list(zip(bodies, Ts_world_obj, strict=True)))
    return tuple(sorted(found, key=lambda f: -1 if f.index is None else f.index))


def _check_amounts(views: Sequence[ViewPoints]) -> list[ViewFinding]:
    """Return views whose depth images are empty, or hold much less than the others'."""
    found: list[ViewFinding] = []
    usual = float(np.median([v.measured_share for v in views]))
    for v in views:
        n, share = len(v.points), v.measured_share
        few = n < LEAST_VIEW_POINTS
        if share == 0:
            words = (
                f"view {v.index}: its depth image is empty; it is left out. Capture it again, and "
                "check that the depth stream was running."
            )
            found.append(ViewFinding(index=v.index, kind="no_depth", words=words, exclude=True))
        elif few or share < LITTLE_SHARE * usual:
            words = (
                f"view {v.index}: only {100 * share:.1f} % of its pixels hold depth ({n} trusted "
                f"points), of the median view's {100 * usual:.0f} %. Usual causes: too near or too "
                "far for the sensor, glass or black things close by, light straight into the lens."
                + (" It is left out." if few else "")
            )
            found.append(ViewFinding(index=v.index, kind="little_depth", words=words, exclude=few))
    return found


def _check_each(
    held: view_agreement.HeldViews, plane: SupportPlane, noise: DepthNoise
) -> list[ViewFinding]:
    """Return the views that are not where the others are, or show another scene."""
    n = len(held.views)
    tables = [view_table(v, plane, noise) for v in held.views]
    offs = _tables_off(held, tables)
    odd = _odd_views(held, offs)
    if not odd:
        return []
    if 2 * len(odd) > n:
        words = (
            f"{len(odd)} of {n} views disagree with the others about what stands on the table "
            f"(numbers {_listed(held, odd)}): which are right cannot be told. Is the depth's unit "
            "right (a few percent are enough), and is it aligned to the colour image? Are the "
            "images of one session, and was nothing moved meanwhile?"
        )
        return [ViewFinding(index=None, kind="all_disagree", words=words, exclude=False)]
    found = [_finding(held, o, odd, (plane, noise)) for o in odd]
    return _with_slip(held, found, odd)


def _odd_views(held: view_agreement.HeldViews, offs: dict[int, str]) -> list[_Odd]:
    """Return the views that disagree with the sound ones.

    A few wrong views spoil the partners of sound ones: the odd views of one round are nobody's
    partners in the next, until the choice stays as it is.
    """
    n = len(held.views)
    bad = set(offs)
    shares = np.zeros(n)
    for round_ in range(ROUNDS):
        shares = np.array([
            view_agreement.contradiction(held, k, _sound_partners(held, k, bad)) for k in range(n)
        ])  # fmt: skip
        usual, spread = _middle(shares.tolist())
        limit = max(PARTLY_SHARE, usual + SPREADS * spread)
        limit = min(limit, FOREIGN_SHARE)
        # The worst first: with many wrong partners sound views look bad as well.
        if round_ < ROUNDS - 1:
            limit = max(limit, WORST_SHARE * float(shares.max()))
        worse = {k for k in range(n) if shares[k] > limit} | set(offs)
        if worse == bad and limit <= FOREIGN_SHARE:
            break
        bad = worse
    return [_Odd(k=k, share=float(shares[k]), off=offs.get(k, "")) for k in sorted(bad)]


def _sound_partners(held: view_agreement.HeldViews, k: int, bad: set[int]) -> Sequence[int]:
    """Return the partners of view k that are not bad, topped up with the nearest sound views."""
    mine = [int(j) for j in held.partners[k]]
    sound = [j for j in mine if j not in bad]
    if len(sound) == len(mine) or 2 * len(bad) > len(held.views):
        return mine
    eyes = held.maps.Ts_world_cam[:, :3, 3]
    order = np.argsort(np.linalg.norm(eyes - eyes[k], axis=1), kind="stable")
    more = [int(j) for j in order if int(j) not in (*bad, *sound, k)]
    return sound + more[: len(mine) - len(sound)]


def _tables_off(held: view_agreement.HeldViews, tables: Sequence[ViewTable]) -> dict[int, str]:
    """Return in words, per view, how its table lies against the others', if it lies wrong.

    A lid of a large box is higher than the table, too; but nobody looks through it.
    """
    seen = [t for t in tables if t.own_share > 0]
    if not seen:
        return {}
    height, height_spread = _middle([t.height_m for t in seen])
    tilt, tilt_spread = _middle([t.tilt_deg for t in seen])
    most_height = max(TABLE_HEIGHT_M, TABLE_SPREADS * height_spread)
    most_tilt = max(TABLE_TILT_DEG, tilt + TABLE_SPREADS * tilt_spread)
    off: dict[int, str] = {}
    for k, t in enumerate(tables):
        if not t.own_share > 0 or t.share > TABLE_KEPT * t.own_share:
            continue
        up = t.height_m - height
        if abs(up) <= most_height and t.tilt_deg <= most_tilt:
            continue
        shift = max(abs(up), LEVER_M * float(np.tan(np.radians(t.tilt_deg))))
        if view_agreement.sheet_contradiction(held, k, 0.5 * shift) > PARTLY_SHARE:
            off[k] = (
                f"it sees the table {1e3 * abs(up):.0f} mm {'above' if up > 0 else 'below'} and "
                f"{t.tilt_deg:.1f} deg tilted against where the others see it"
            )
    return off


def _finding(
    held: view_agreement.HeldViews,
    odd: _Odd,
    all_odd: Sequence[_Odd],
    table: tuple[SupportPlane, DepthNoise],
) -> ViewFinding:
    """Return what is wrong with a view that is not where the others are."""
    index = held.views[odd.k].index
    other = _pose_of(held, odd, all_odd, table)
    kind: Kind = "pose_of_another"
    if other is not None:
        words = (
            f"view {index}: its image does not fit its camera pose but that of view "
            f"{held.views[other].index}: images and poses are mixed up there."
        )
    elif odd.off:
        kind = "table_off"
        words = (
            f"view {index}: {odd.off}: its camera pose is not that of its image. Was the arm "
            "still moving, or did the mount slip?"
        )
    elif odd.share > FOREIGN_SHARE:
        kind = "foreign"
        words = (
            f"view {index}: it shows another scene: {100 * odd.share:.0f} % of what it and the "
            "others see on the table is looked through by the other side. Is it of this session, "
            "and was nothing moved?"
        )
    else:
        kind = "partly_foreign"
        words = (
            f"view {index}: {100 * odd.share:.0f} % of what it and the others see on the table is "
            "looked through by the other side: something was moved, or its camera pose is off by "
            "a centimetre. It is used all the same."
        )
    exclude = kind != "partly_foreign"
    return ViewFinding(
        index=index, kind=kind, words=words + (" It is left out." if exclude else ""),
        exclude=exclude,
    )  # fmt: skip


def _pose_of(
    held: view_agreement.HeldViews,
    odd: _Odd,
    all_odd: Sequence[_Odd],
    table: tuple[SupportPlane, DepthNoise],
) -> int | None:
    """Return the view whose camera pose fits this view's image, if one does."""
    bad = {o.k for o in all_odd}
    sound = [k for k in range(len(held.views)) if k not in bad]
    Ts = held.maps.Ts_world_cam
    eyes = Ts[sound, :3, 3]
    best, best_support = None, view_agreement.SCENE_SUPPORT
    for u in range(len(held.views)):
        if u == odd.k:
            continue
        order = np.argsort(np.linalg.norm(eyes - Ts[u, :3, 3], axis=1), kind="stable")
        near = [sound[int(i)] for i in order if sound[int(i)] != u][: view_agreement.NEAR + 1]
        gain = view_agreement.support(held, odd.k, near, Ts[u])
        if gain <= best_support:
            continue
        rest = view_agreement.contradiction(held, odd.k, near, Ts[u])
        moved = view_table(replace(held.views[odd.k], T_world_cam=Ts[u]), table[0], table[1])
        flat = moved.share > TABLE_KEPT * moved.own_share
        before = max(odd.share, PARTLY_SHARE)
        if flat and rest < min(PARTLY_SHARE, SOLVED_SHARE * before):
            best, best_support = u, gain
    return best


def _with_slip(
    held: view_agreement.HeldViews, found: Sequence[ViewFinding], odd: Sequence[_Odd]
) -> list[ViewFinding]:
    """Return the findings; a run of displaced views up to the last is a mount that slipped."""
    first, n = odd[0].k, len(held.views)
    run = [o.k for o in odd] == list(range(first, n))
    displaced = sum(f.kind in ("table_off", "partly_foreign") for f in found)
    if not run or first == 0 or len(odd) == 1 or 2 * displaced < len(found):
        return list(found)
    where = held.views[first].index
    return [
        replace(
            f,
            kind="slipped",
            exclude=True,
            words=f"view {f.index}: all {len(odd)} views from {where} on see the table or what "
            "stands on it elsewhere than those before: did the camera's mount slip, or was the "
            f"table moved, before view {where}? It is left out.",
        )
        for f in found
    ]


def _check_objects(
    views: Sequence[ViewPoints],
    plane: SupportPlane,
    noise: DepthNoise,
    placed: Sequence[tuple[Body, Array]],
) -> list[ViewFinding]:
    """Return the views whose points on the table are on none of the registered objects."""
    shares: list[float] = []
    told: list[ViewPoints] = []
    for v in views:
        share = _unexplained(v, plane, noise, placed)
        if share is not None:
            shares.append(share)
            told.append(v)
    if not shares:
        return []
    usual = float(np.median(shares))
    return [
        ViewFinding(
            index=v.index,
            kind="objects_off",
            words=f"view {v.index}: {100 * share:.0f} % of what it sees around the registered "
            f"objects is on none of them (of the median view {100 * usual:.0f} %): its image or "
            "its camera pose is another's. It is left out.",
            exclude=True,
        )
        for v, share in zip(told, shares, strict=True)
        if share > usual + OBJECT_SHARE
    ]


def _unexplained(
    view: ViewPoints, plane: SupportPlane, noise: DepthNoise, placed: Sequence[tuple[Body, Array]]
) -> float | None:
    """Return the share of a view's points around the objects that lie on none; None = too few."""
    rng = np.random.default_rng((view_agreement.SEED, view.index))
    few = view.points[rng.integers(0, len(view.points), 4 * view_agreement.POINTS)].astype(
        np.float64
    )
    p = se3.transform(view.T_world_cam, few)
    height = se3.transform(se3.invert(plane.T_world_table), p)[:, 2]
    sigma = noise.sigma(few[:, 2])
    above = height > view_agreement.ABOVE_M + view_agreement.SIGMAS * sigma
    nearest = np.full(len(p), np.inf)
    around = np.zeros(len(p), dtype=bool)
    for body, T in placed:
        close = np.linalg.norm(p - body.center(T), axis=1) < body.radius_m + OBJECT_REACH_M
        around |= close
        some = np.flatnonzero(close & above)
        gap = np.abs(body.field.distance(p[some], se3.invert(T)))
        nearest[some] = np.minimum(nearest[some], gap)
    mine = around & above
    if np.count_nonzero(mine) < view_agreement.LEAST_DECIDED:
        return None
    return float(np.mean(nearest[mine] > OBJECT_REACH_M + view_agreement.SIGMAS * sigma[mine]))


def _middle(values: Sequence[float]) -> tuple[float, float]:
    """Return the median and the robust standard deviation."""
    x = np.asarray(values, dtype=np.float64)
    middle = float(np.median(x))
    return middle, float(MAD_TO_SIGMA * np.median(np.abs(x - middle)))


def _listed(held: view_agreement.HeldViews, odd: Sequence[_Odd]) -> str:
    """Return the numbers of views, the first dozen of them."""
    numbers = [str(held.views[o.k].index) for o in odd[:LISTED]]
    return ", ".join(numbers) + (" ..." if len(odd) > LISTED else "")
