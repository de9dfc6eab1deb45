"""Do the controller's poses belong to the flange? Compare them with the nominal kinematics.

T_base_ee = L T_nominal E: a constant E on the right is a tool offset that was left active (a TCP),
a constant L on the left another base frame. A robot's own poses differ from the nominal kinematics
by 1 to 3 mm and 0.1 to 0.5 deg, which varies with the pose; more, and constant, is a frame. Both
frames come from the same robust fit as a hand-eye, with the nominal poses in the camera's place.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Int64
from realsim.geometry import se3
from realsim_calibration.faults.frame_fit import fit_frames, mean_transform
from realsim_calibration.fit.closed_forms import MIN_VIEWS, pose_stacks

LEAST_MM = 5.0
"""Offsets below this are the nominal kinematics' own error [mm]: real arms show 1 to 3."""
LEAST_DEG = 1.5
"""The same for angles [deg]."""
SIMPLER = 2.0
"""A frame fewer is believed while it fits at most this many times worse."""
FLOOR_MM = 4.0
"""It is believed, too, while it fits to this RMS [mm]."""
MIN_GROUP = 3
"""Fewest views that share a tool offset where it changes."""
LEVER_M = 0.5
"""Angles count as the slip they make at this distance [m]."""
MAX_ERROR_MM = 15.0
"""Beyond this RMS the nominal poses belong to another robot or to other joints [mm]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ToolOffset:
    """How the controller's poses differ from the nominal kinematics."""

    known: bool
    """Whether the nominal poses fit at all; else nothing is claimed."""
    offsets: tuple[Array, ...]
    """(4, 4) T_flange_ee of every stretch of views; one where it is constant [m]."""
    active: bool
    """Whether some offset is more than the nominal kinematics' own error."""
    base_turned: bool
    """Whether the base frames differ."""
    sentence: str
    advice: str


def tool_offset(Ts_base_ee: ArrayLike, nominal: ArrayLike) -> ToolOffset:
    """Return the constant frames between the controller's poses and the nominal ones.

    Args:
        Ts_base_ee: (n, 4, 4) the controller's poses [m].
        nominal: (n, 4, 4) T_base_flange from the joints by the nominal kinematics [m].

    Raises:
        InputError: stacks of different lengths, or fewer than three views.
    """
    A, N = pose_stacks(Ts_base_ee, nominal, "tool offset", least=MIN_VIEWS, others="nominal poses")
    L, offsets, groups, error = _simplest(A, N)
    mm, deg = _rms(error)
    known = mm <= MAX_ERROR_MM
    active = known and any(_differs(E) for E in offsets)
    turned = known and _differs(L)
    sentence, advice = _sentence(L, offsets, groups, (mm, deg), known)
    return ToolOffset(
        known=known, offsets=offsets, active=active, base_turned=turned, sentence=sentence,
        advice=advice,
    )  # fmt: skip


def _simplest(A: Array, N: Array) -> tuple[Array, tuple[Array, ...], Int64, Array]:
    """Return L, offsets, groups, errors (n, 6) of the simplest model that fits nearly as well."""
    one = np.zeros(len(A), dtype=np.int64)
    I4 = np.eye(4)
    fit = fit_frames(A, se3.invert(N))
    turn = se3.from_rt(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    # Typical cases first, each with an exact base: a tool, the base turned by 180 deg, then any.
    models: list[tuple[Array, tuple[Array, ...], Int64]] = [
        (I4, (I4,), one),
        (I4, (mean_transform(se3.invert(N) @ A),), one),
        (turn, (mean_transform(se3.invert(turn @ N) @ A),), one),
        (mean_transform(A @ se3.invert(N)), (I4,), one),
        (fit.Z, (se3.invert(fit.X),), one),
    ]
    for base in (I4, turn):
        offsets, groups = _groups(se3.invert(base @ N) @ A)
        # Offsets of a view or two are wrong poses, not tools.
        if len(offsets) > 1 and np.bincount(groups).min() >= MIN_GROUP:
            models.append((base, offsets, groups))
    results: list[tuple[float, tuple[Array, tuple[Array, ...], Int64, Array]]] = []
    for base, offsets, groups in models:
        ends = np.array(offsets)[groups]
        error = se3.log(se3.invert(base @ N @ ends) @ A)
        mm, deg = _rms(error)
        cost = float(np.hypot(mm, 1e3 * LEVER_M * np.radians(deg)))
        results.append((cost, (base, offsets, groups, error)))
    least = min(cost for cost, _ in results)
    limit = max(SIMPLER * least, FLOOR_MM)
    return next(model for cost, model in results if cost <= limit)


def _groups(Ts: Array) -> tuple[tuple[Array, ...], Int64]:
    """Return the different transforms among (n, 4, 4) and which one each view has."""
    groups = np.full(len(Ts), -1)
    offsets: list[Array] = []
    for k in range(len(Ts)):
        if groups[k] >= 0:
            continue
        step = se3.log(se3.invert(Ts[k]) @ Ts)
        near = np.linalg.norm(step[:, 3:], axis=-1) < 2e-3 * LEAST_MM
        near &= np.linalg.norm(step[:, :3], axis=-1) < np.radians(2 * LEAST_DEG)
        members = near & (groups < 0)
        groups[members] = len(offsets)
        offsets.append(mean_transform(Ts[members]))
    return tuple(offsets), groups.astype(np.int64)


def _rms(error: Array) -> tuple[float, float]:
    mm = 1e3 * np.sqrt(np.mean(np.sum(error[:, 3:] ** 2, -1)))
    return float(mm), float(np.degrees(np.sqrt(np.mean(np.sum(error[:, :3] ** 2, -1)))))


def _differs(T: Array) -> bool:
    far = np.linalg.norm(T[:3, 3]) > 1e-3 * LEAST_MM
    return bool(far or np.degrees(se3.angle(T)) > LEAST_DEG)


def describe_offset(T: Array) -> str:
    """Return "200.7 mm along the flange's z" for a transform, with its turn where it has one."""
    t = 1e3 * T[:3, 3]
    length = float(np.linalg.norm(t))
    axis = int(np.argmax(np.abs(t)))
    if length < 0.05:
        text = "at the flange"
    elif abs(t[axis]) > 0.995 * length:
        text = f"{length:.1f} mm along the flange's {'-' if t[axis] < 0 else ''}{'xyz'[axis]}"
    else:
        text = f"{length:.1f} mm away, at ({t[0]:.1f}, {t[1]:.1f}, {t[2]:.1f}) mm in the flange"
    angle = float(np.degrees(se3.angle(T)))
    return text + (f", turned by {angle:.1f} deg" if angle > 1.0 else "")


def _sentence(
    L: Array, offsets: tuple[Array, ...], groups: Int64, rms: tuple[float, float],
    known: bool, ) -> tuple[str, str]:  # fmt: skip
    rest = f"what remains is {rms[0]:.1f} mm and {rms[1]:.2f} deg RMS"
    if not known:
        return (
            f"The poses are not those of the nominal kinematics at any constant tool: {rest}.",
            "Check that the robot's model and the order and unit of its joints are right.",
        )
    parts: list[str] = []
    advice = ""
    if len(offsets) > 1:
        counts = np.bincount(groups)
        texts = [f"{n} views {describe_offset(E)}" for E, n in zip(offsets, counts, strict=True)]
        parts.append(f"The tool offset changes within the poses: {'; '.join(texts)}.")
        advice = "Give every pose for the same tool: read the flange, or set one TCP throughout."
    elif offsets and _differs(offsets[0]):
        parts.append(f"The poses are of a point {describe_offset(offsets[0])}.")
        advice = (
            "A tool offset (TCP) is active in the controller: the camera's place will be given "
            "from that point, and is right only while the same TCP is set. Set it to zero to get "
            "the camera in the flange."
        )
    if _differs(L):
        angle = float(np.degrees(se3.angle(L)))
        axis = se3.log_so3(L[:3, :3]) / max(np.radians(angle), 1e-9)
        z = abs(axis[2]) > 0.99
        parts.append(
            f"The controller's base is turned by {angle:.1f} deg"
            + (" about z" if z else "")
            + f" and moved by {1e3 * np.linalg.norm(L[:3, 3]):.1f} mm against the nominal one"
            + (" (`base` and `base_link` of ROS)." if z and angle > 178 else ".")
        )
        advice = (advice + " This does not affect a camera in the hand, but poses of the board "
                  "and of objects are in the controller's base.").strip()  # fmt: skip
    if not parts:
        return f"The poses are those of the flange: {rest}.", ""
    return " ".join([*parts, f"{rest[0].upper()}{rest[1:]}."]), advice
