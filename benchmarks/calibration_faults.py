"""How often does the convention test name the fault that was put into the data?

Imported by `calibration.py` (`--part faults`).

Every trial draws a session (a hemisphere of 12 to 40 views with roll over a chessboard, camera in
the hand or fixed; robot 0.5 mm and 0.5 mrad, board poses 0.3 mm and 0.1 deg per axis), puts one
fault into it and asks for the diagnosis. A fault is named when its kind and its views are right,
and where rotations were misread when the repaired rotations are the true ones. The clean sessions
hold few views, small motions and a bad robot too: anything but "none" is a false alarm.
"""

import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from realsim.arrays import Array, Rows
from realsim.geometry import se3
from realsim.records import Chessboard
from realsim_calibration.faults.diagnose import diagnose
from realsim_calibration.faults.diagnosis import Diagnosis
from realsim_calibration.faults.half_turns import half_turn
from realsim_calibration.faults.rotation_readings import (
    Convention,
    four_number_conventions,
    three_number_conventions,
)

Rng = np.random.Generator
BOARD = Chessboard(rows=5, columns=9, square_m=0.02)
"""Odd by odd inner corners: the same turned by 180 deg."""
ROTVEC = three_number_conventions()[0]
EULER = three_number_conventions()[1:]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Session:
    """Poses with or without a fault, and what the diagnosis must say."""

    T: Array
    """(n, 4, 4) T_base_ee."""
    C: Array
    """(n, 4, 4) T_cam_board."""
    nominal: Array | None
    """(n, 4, 4) T_base_flange by imperfect kinematics."""
    eye_in_hand: bool
    target: Chessboard = BOARD
    expected: tuple[str, ...] = ("none",)
    views: tuple[int, ...] | None = None
    """Rows that must be named; None = any."""
    true_R: Array | None = None
    """(n, 3, 3) the rotations that a repair must bring back."""


def draw_session(
    rng: Rng,
    *,
    views: tuple[int, int] = (12, 40),
    robot: tuple[float, float] = (0.5e-3, 0.5e-3),
    small_deg: float = 0.0,
) -> Session:
    """Return a clean session; `small_deg` > 0 keeps all turns within about this angle."""
    n = int(rng.integers(views[0], views[1] + 1))
    eye_in_hand = bool(rng.random() < 0.5)
    middle = BOARD.points_board.mean(0)
    C: list[Array] = []
    start = se3.invert(
        se3.look_at(middle + np.array([0.05, 0.08, -0.4]), middle, rng.uniform(-3, 3))
    )
    for _ in range(n):
        if small_deg > 0:
            w = rng.normal(size=3)
            w *= np.radians(small_deg) * np.cbrt(rng.random()) / np.linalg.norm(w)
            about = se3.from_translation(start[:3, :3] @ middle + start[:3, 3])
            step = se3.exp(np.concatenate([w, rng.normal(scale=0.02, size=3)]))
            C.append(about @ step @ se3.invert(about) @ start)
            continue
        tilt, azimuth = np.radians(rng.uniform(0, 45)), rng.uniform(0, 2 * np.pi)
        away = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)]
        eye = middle + rng.uniform(0.3, 0.5) * np.array(away)
        aim = middle + rng.normal(scale=0.03, size=3) * [1, 1, 0]
        C.append(se3.invert(se3.look_at(eye, aim, rng.uniform(-np.pi, np.pi))))
    Cs = np.array(C)
    in_hand = se3.from_rt(
        se3.exp_so3([0.1, -0.05, 1.5]) @ se3.exp_so3(rng.normal(scale=0.3, size=3)),
        rng.normal(loc=[0.0, 0.0, 0.06], scale=0.05),
    )
    down = np.diag([1.0, -1.0, -1.0]) @ se3.exp_so3(rng.normal(scale=0.15, size=3))
    place = se3.from_rt(down, [rng.uniform(0.35, 0.6), rng.uniform(-0.3, 0.3), 0.02])
    if not eye_in_hand:
        place = place @ se3.from_translation([0.0, 0.0, -0.9])
        place = place @ se3.exp(np.concatenate([rng.normal(scale=0.2, size=3), np.zeros(3)]))
    T = place @ (se3.invert(Cs) if eye_in_hand else Cs) @ se3.invert(in_hand)

    def noise(length: float, angle: float) -> Array:
        turns, slips = (rng.normal(scale=sd, size=(n, 3)) for sd in (angle, length))
        return se3.exp(np.concatenate([turns, slips], -1))

    return Session(
        T=T @ noise(*robot), C=Cs @ noise(0.3e-3, np.radians(0.1)),
        nominal=T @ noise(1e-3, 2e-3), eye_in_hand=eye_in_hand,
    )  # fmt: skip


def _numbers(convention: Convention, R: Array) -> Array:
    """Return the numbers that a program writes: middle Euler angle within 90 deg, short rotvec."""
    return convention.encode(R)[:, 0]


def _misread(s: Session, meant: Convention, read_as: Convention, factor: float = 1.0) -> Session:
    R = s.T[:, :3, :3]
    wrong = read_as.decode(factor * _numbers(meant, R))
    T = se3.from_rt(wrong, s.T[:, :3, 3])
    return replace(s, T=T, expected=("rotation_reading",), true_R=R, nominal=None)


def _other(rng: Rng, conventions: tuple[Convention, ...], meant: Convention) -> Convention:
    rest = [c for c in conventions if c.name != meant.name]
    return rest[int(rng.integers(len(rest)))]


def euler_order(s: Session, rng: Rng) -> Session:
    """Euler angles decoded in another order."""
    meant = EULER[int(rng.integers(len(EULER)))]
    return _misread(s, meant, _other(rng, EULER, meant))


def rotvec_as_euler(s: Session, rng: Rng) -> Session:
    """A rotation vector decoded as Euler angles."""
    return _misread(s, ROTVEC, EULER[int(rng.integers(len(EULER)))])


def euler_as_rotvec(s: Session, rng: Rng) -> Session:
    """Euler angles decoded as a rotation vector."""
    return _misread(s, EULER[int(rng.integers(len(EULER)))], ROTVEC)


def quaternion_order(s: Session, rng: Rng) -> Session:
    """Quaternions read x y z w for w x y z, or the other way round."""
    pair = four_number_conventions()
    k = int(rng.integers(2))
    return _misread(s, pair[k], pair[1 - k])


def degrees_as_radians(s: Session, rng: Rng) -> Session:
    """Angles in degrees taken for radians."""
    c = (ROTVEC, *EULER)[int(rng.integers(1 + len(EULER)))]
    s = replace(_misread(s, c, c, 180 / np.pi), expected=("degrees_as_radians",))
    # Degrees known modulo 2 pi cannot be brought back.
    return replace(s, true_R=None)


def radians_as_degrees(s: Session, rng: Rng) -> Session:
    """Angles in radians taken for degrees."""
    c = (ROTVEC, *EULER)[int(rng.integers(1 + len(EULER)))]
    return replace(_misread(s, c, c, np.pi / 180), expected=("radians_as_degrees",))


def robot_inverted(s: Session, rng: Rng) -> Session:
    """T_ee_base given for T_base_ee."""
    del rng
    return replace(s, T=se3.invert(s.T), nominal=None, expected=("robot_inverted",))


def camera_inverted(s: Session, rng: Rng) -> Session:
    """T_board_cam given for T_cam_board."""
    del rng
    return replace(s, C=se3.invert(s.C), nominal=None, expected=("camera_inverted",))


def wrong_mode(s: Session, rng: Rng) -> Session:
    """A camera in the hand said to stand still, or the other way round."""
    del rng
    return replace(s, eye_in_hand=not s.eye_in_hand, nominal=None, expected=("robot_inverted",))


def robot_in_mm(s: Session, rng: Rng) -> Session:
    """Hand poses in millimetres."""
    del rng
    return replace(s, T=_scaled(s.T, 1000.0), nominal=None, expected=("robot_unit",))


def board_in_mm(s: Session, rng: Rng) -> Session:
    """A board given in millimetres."""
    del rng
    target = replace(BOARD, square_m=BOARD.square_m)
    return replace(s, C=_scaled(s.C, 1000.0), target=target, expected=("board_unit",))


def board_size(s: Session, rng: Rng) -> Session:
    """A square of another size."""
    factor = float(rng.choice([35 / 19, 19 / 35, 30 / 25, 20 / 24, 1.1, 1 / 1.1]))
    target = replace(BOARD, square_m=BOARD.square_m * factor)
    return replace(s, C=_scaled(s.C, factor), target=target, expected=("board_size",))


def _scaled(T: Array, factor: float) -> Array:
    return se3.from_rt(T[:, :3, :3], factor * T[:, :3, 3])


def mirrored(s: Session, rng: Rng) -> Session:
    """An axis counted the other way: of the positions, of the rotations, or of both."""
    S = np.eye(3)
    k, what = (int(v) for v in rng.integers(3, size=2))
    S[k, k] = -1.0
    R, t = s.T[:, :3, :3], s.T[:, :3, 3]
    T = se3.from_rt(S @ R @ S if what != 0 else R, t @ S if what != 1 else t)
    return replace(s, T=T, nominal=None, expected=("mirrored_axis",))


def _far_pair(s: Session, rng: Rng) -> tuple[int, int]:
    """Return two views that differ enough for an exchange to matter (20 deg or 10 cm)."""
    pairs = [rng.choice(len(s.C), 2, replace=False) for _ in range(20)]
    step = [se3.invert(s.C[a]) @ s.C[b] for a, b in pairs]
    size = [se3.angle(T) / np.radians(20) + np.linalg.norm(T[:3, 3]) / 0.1 for T in step]
    a, b = pairs[next((k for k, v in enumerate(size) if v > 1), int(np.argmax(size)))]
    return int(a), int(b)


def swapped(s: Session, rng: Rng) -> Session:
    """Two images exchanged."""
    a, b = _far_pair(s, rng)
    C = s.C.copy()
    C[[a, b]] = C[[b, a]]
    return replace(s, C=C, expected=("swapped_images",), views=tuple(sorted((a, b))))


def mispaired(s: Session, rng: Rng) -> Session:
    """One image of a place that is not in the list."""
    a, b = _far_pair(s, rng)
    C = s.C.copy()
    C[a] = C[b]
    keep = np.flatnonzero(np.arange(len(C)) != b)
    return replace(_take(s, keep, keep, C), expected=("mispaired_image",), views=(a - (b < a),))


def _take(s: Session, poses: Rows, images: Rows, C: Array | None = None) -> Session:
    C = s.C if C is None else C
    nominal = None if s.nominal is None else s.nominal[poses]
    return replace(s, T=s.T[poses], C=C[images], nominal=nominal)


def _shift(rng: Rng) -> int:
    return int(rng.choice([-3, -2, -1, 1, 2, 3]))


def shifted(s: Session, rng: Rng) -> Session:
    """All images paired with a pose one to three places off."""
    k, n = _shift(rng), len(s.T)
    poses, images = np.arange(max(-k, 0), n - max(k, 0)), np.arange(max(k, 0), n + min(k, 0))
    return replace(_take(s, poses, images), expected=("shifted_pairing",))


def shifted_later(s: Session, rng: Rng) -> Session:
    """A detection failed in the middle: every later image is paired with an earlier pose.

    Three later images at least still have a pose to which they can be traced.
    """
    k, n = _shift(rng), len(s.T)
    first = max(n // 4, 4)
    while n - 2 * abs(k) - 3 < first:
        k -= int(np.sign(k))
    m = int(rng.integers(first, min(3 * n // 4 - 2, n - 2 * abs(k) - 3) + 1))
    gap = np.concatenate([np.arange(m), np.arange(m + abs(k), n)])
    every = np.arange(len(gap))
    poses, images = (every, gap) if k > 0 else (gap, every)
    return replace(
        _take(s, poses, images), expected=("shifted_pairing",), views=tuple(range(m, len(gap)))
    )


def flipped(s: Session, rng: Rng) -> Session:
    """Boards read turned by 180 deg."""
    n = len(s.C)
    count = int(rng.integers(1, (n - 1) // 2 + 1))
    rows = np.sort(rng.choice(n, count, replace=False))
    C = s.C.copy()
    C[rows] = C[rows] @ half_turn(s.target.points_board.mean(0))
    return replace(s, C=C, expected=("board_flips",), views=tuple(int(r) for r in rows))


def tool_left_active(s: Session, rng: Rng) -> Session:
    """A TCP 200.7 mm along the flange's z was active."""
    del rng
    return replace(s, T=s.T @ se3.from_translation([0, 0, 0.2007]), expected=("tool_offset",))


def tool_changed(s: Session, rng: Rng) -> Session:
    """The TCP was set in the middle of the session."""
    n = len(s.T)
    m = int(rng.integers(max(n // 4, 4), n - max(n // 4, 4) + 1))
    T = s.T.copy()
    T[m:] = T[m:] @ se3.from_translation([0, 0, 0.2007])
    return replace(s, T=T, expected=("tool_change",), views=tuple(range(m, n)))


def base_turned(s: Session, rng: Rng) -> Session:
    """Poses in `base`, kinematics in `base_link`."""
    del rng
    half = se3.from_rt(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    return replace(s, T=half @ s.T, expected=("base_turned",))


def duplicated(s: Session, rng: Rng) -> Session:
    """One view is in the list twice."""
    k = int(rng.integers(len(s.T)))
    rows = np.append(np.arange(len(s.T)), k)
    return replace(_take(s, rows, rows), expected=("duplicated_views",), views=(len(s.T),))


def frozen(s: Session, rng: Rng) -> Session:
    """The controller delivered one pose for two or three images."""
    k, more = int(rng.integers(len(s.T) - 3)), int(rng.integers(1, 3))
    T = s.T.copy()
    T[k + 1 : k + 1 + more] = T[k]
    return replace(s, T=T, expected=("frozen_pose",), views=tuple(range(k + 1, k + 1 + more)))


def board_moved(s: Session, rng: Rng) -> Session:
    """What stands still was moved in the middle of the session."""
    n = len(s.T)
    m = int(rng.integers(max(n // 4, 4), n - max(n // 4, 4) + 1))
    step = se3.exp(rng.choice([-1, 1], 6) * rng.uniform(0.06, 0.2, 6))
    T = s.T.copy()
    T[m:] = step @ T[m:]
    name = "board_moved" if s.eye_in_hand else "camera_moved"
    return replace(s, T=T, nominal=None, expected=(name,), views=tuple(range(m, n)))


FAULTS: dict[str, Callable[[Session, Rng], Session]] = {
    f.__name__: f
    for f in (
        euler_order, rotvec_as_euler, euler_as_rotvec, quaternion_order, degrees_as_radians,
        radians_as_degrees, robot_inverted, camera_inverted, wrong_mode, robot_in_mm, board_in_mm,
        board_size, mirrored, swapped, mispaired, shifted, shifted_later, flipped, tool_left_active,
        tool_changed, base_turned, duplicated, frozen, board_moved,
    )
}  # fmt: skip
CLEAN: dict[str, dict[str, object]] = {
    "clean": {},
    "clean, 5 to 8 views": {"views": (5, 8)},
    "clean, turns of 10 deg": {"small_deg": 10.0},
    "clean, 6 to 10 views, 10 deg": {"views": (6, 10), "small_deg": 10.0},
    "clean, robot 3 mm 4 mrad": {"robot": (3e-3, 4e-3)},
    "clean, 10 deg, 3 mm 4 mrad": {"robot": (3e-3, 4e-3), "small_deg": 10.0},
}


def named(s: Session, d: Diagnosis) -> bool:
    """Return whether a diagnosis says what is wrong with a session."""
    if d.fault not in s.expected or (s.views is not None and d.views != s.views):
        return False
    if s.true_R is None:
        return True
    if d.repaired_base_ee is None or len(d.repaired_base_ee) != len(s.true_R):
        return False
    off = se3.angle(np.swapaxes(d.repaired_base_ee[:, :3, :3], -1, -2) @ s.true_R)
    return bool(off.max() < 1e-3)


def layouts_that_are_read() -> dict[str, str]:
    """Return every layout of images and poses that was written; "" where it was read back right."""
    sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))
    from pose_layouts import layouts_read  # pyright: ignore[reportMissingImports]

    with tempfile.TemporaryDirectory() as place:
        return layouts_read(Path(place))


def ask(s: Session) -> Diagnosis:
    """Return the diagnosis of a session."""
    return diagnose(
        s.T, s.C, target=s.target, nominal=s.nominal,
        mode="eye_in_hand" if s.eye_in_hand else "eye_to_hand",
    )  # fmt: skip


def faults_named_share(
    trials: int = 10, seed: int = 0
) -> tuple[float, list[tuple[str, int, int, dict[str, int]]]]:
    """Return the share of faults named, and (fault, named, missed, what was said) of each.

    Clean sessions count as named when the diagnosis is "none".
    """
    table: list[tuple[str, int, int, dict[str, int]]] = []
    for row, name in enumerate([*FAULTS, *CLEAN]):
        said: Counter[str] = Counter()
        hits = 0
        for trial in range(trials):
            rng = np.random.default_rng([seed, row, trial])
            if name in FAULTS:
                s = FAULTS[name](draw_session(rng), rng)
            else:
                s = draw_session(rng, **CLEAN[name])  # pyright: ignore[reportArgumentType]
            d = ask(s)
            hit = named(s, d)
            hits += hit
            said[d.fault if hit or d.fault not in s.expected else f"{d.fault}, but not which"] += 1
        table.append((name, hits, trials - hits, dict(said)))
    total = sum(hits + misses for _, hits, misses, _ in table)
    return sum(hits for _, hits, _, _ in table) / total, table
