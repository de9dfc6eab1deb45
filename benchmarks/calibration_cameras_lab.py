"""A simulated lab: a UR3 with a camera in its hand and three that stand round it.

Imported by `calibration_cameras.py`. Nothing here is the solver's: the arm is a product of its own
elementary transforms whose joints are off, whose links have other lengths and twists, which sags
under its own weight as its joints are elastic, and whose gears have play. The controller reports
the nominal arm's pose. Lenses bend by more than the five terms say, prints are misprinted and bent.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim.geometry.dh import DhArm
from realsim.records import TagBoard
from realsim_calibration.cameras.rig import Instant, Rig, RigBoard, RigCamera, Sighting
from realsim_calibration.views import TargetDetection

Rng = np.random.Generator
A3 = np.array([0.0, -0.24365, -0.21325, 0.0, 0.0, 0.0])
D3 = np.array([0.1519, 0.0, 0.0, 0.11235, 0.08535, 0.0819])
ALPHA3 = np.array([np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0])
UR3 = DhArm(name="ur3", a=A3, d=D3, alpha=ALPHA3)
"""What the calibration is told of the arm where it is told the joints."""
MASS_KG = np.array([2.0, 3.42, 1.26, 0.8, 0.8, 0.35 + 0.4])
"""Links, the last one with camera and board."""
MIDDLES = np.array([[0, -0.02, 0], [0.13, 0, 0.12], [0.1, 0, 0.01], [0, 0, 0.01], [0, 0, 0.01],
                    [0.0, 0.0, 0.03]])  # fmt: skip
"""Centres of mass in the links' frames [m], roughly."""
STIFF_NM = np.array([15e3, 12e3, 9e3, 4e3, 4e3, 4e3])
"""Stiffness of the joints [N m / rad], 1-sigma 20 %."""
ZERO_RAD, TWIST_RAD, LENGTH_M, PLAY_RAD = 3e-4, 2e-4, 2e-4, 5e-5
"""1-sigma of joint zeros, twists and lengths after a factory calibration; half a gear's play."""
LOOKS_DOWN = np.array([0.0, -1.45, 1.75, -1.87, -1.57, 0.0])
SPREAD_RAD = np.array([0.35, 0.22, 0.3, 0.35, 0.35, 0.9])
TABLE = TagBoard(rows=5, columns=6, tag_size_m=0.026, gap_m=0.008)
HELD = TagBoard(rows=4, columns=5, tag_size_m=0.024, gap_m=0.007, first_id=100)
NAMES = ("wrist", "left", "right", "front")
SHARE_SEEN = 0.4
"""Share of a board's points that must be in the image."""
MOST_SLANT = np.cos(np.radians(65.0))


def turned(axis: int, angle: Array) -> Array:
    """Return rotations (..., 4, 4) about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    T = np.zeros((*np.shape(angle), 4, 4))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    T[..., 3, 3] = T[..., axis, axis] = 1.0
    T[..., i, i], T[..., i, j], T[..., j, i], T[..., j, j] = c, -s, s, c
    return T


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Arm:
    """An arm as it is: off by small numbers, elastic, with play."""

    zeros: Array
    twists: Array
    a: Array
    d: Array
    stiff: Array

    @classmethod
    def drawn(cls, rng: Rng) -> "Arm":
        """Return an arm of random errors."""
        return cls(
            zeros=rng.normal(scale=ZERO_RAD, size=6), twists=rng.normal(scale=TWIST_RAD, size=6),
            a=A3 + rng.normal(scale=LENGTH_M, size=6), d=D3 + rng.normal(scale=LENGTH_M, size=6),
            stiff=STIFF_NM * np.exp(rng.normal(scale=0.2, size=6)),
        )  # fmt: skip

    def frames(self, q: Array) -> Array:
        """Return the links' frames (7, 4, 4) at angles that the joints really have."""
        found = [np.eye(4)]
        for k in range(6):
            T = found[-1] @ turned(2, q[k] + self.zeros[k])
            T = T @ se3.from_translation([self.a[k], 0.0, self.d[k]])
            found.append(T @ turned(0, ALPHA3[k] + self.twists[k]))
        return np.stack(found)

    def pose(self, q: Array, rng: Rng) -> Array:
        """Return where the hand (4, 4) really is when the encoders say q."""
        frames = self.frames(q)
        centres = np.stack([se3.transform(T, m[None])[0] for T, m in
                            zip(frames[1:], MIDDLES, strict=True)])  # fmt: skip
        sag = np.zeros(6)
        for k in range(6):
            axis, at = frames[k, :3, 2], frames[k, :3, 3]
            weights = np.outer(MASS_KG[k:], [0.0, 0.0, -9.81])
            torque = float(axis @ np.cross(centres[k:] - at, weights).sum(0))
            sag[k] = torque / self.stiff[k]
        return self.frames(q + sag + rng.uniform(-PLAY_RAD, PLAY_RAD, 6))[-1]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Eye:
    """A camera as it is."""

    name: str
    place: Array
    """(4, 4) in the hand or in the base [m]."""
    size: tuple[int, int]
    focal: Array
    centre: Array
    k: Array
    """(5,) OpenCV's."""
    more: Array
    """(4,) what no five terms say: thin prism and a wave along the radius [px at the border]."""

    def see(self, points: Array) -> Array:
        """Return pixels (n, 2) of points (n, 3) in the camera; NaN behind it."""
        z = np.where(points[:, 2] > 0.05, points[:, 2], np.nan)
        x, y = points[:, 0] / z, points[:, 1] / z
        r2 = x * x + y * y
        k1, k2, p1, p2, k3 = self.k
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        border = (np.hypot(*self.size) / 2 / self.focal.mean()) ** 2
        s = r2 / border
        wave = self.more[2] * np.sin(3 * np.pi * s) + self.more[3] * s**4
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        r = np.maximum(np.sqrt(r2), 1e-9)
        return np.stack([
            self.focal[0] * u + self.centre[0] + self.more[0] * s + wave * x / r,
            self.focal[1] * v + self.centre[1] + self.more[1] * s + wave * y / r,
        ], -1)  # fmt: skip


def _eye(rng: Rng, name: str, place: Array, size: tuple[int, int], focal: float) -> Eye:
    return Eye(
        name=name, place=place, size=size, focal=focal * (1 + rng.normal(scale=[0.004, 0.001])),
        centre=(np.array(size) - 1) / 2 + rng.normal(scale=8.0, size=2),
        k=rng.normal(scale=[0.06, 0.04, 4e-4, 4e-4, 0.01]), more=rng.normal(scale=0.1, size=4),
    )  # fmt: skip


def printed(rng: Rng, board: TagBoard) -> Array:
    """Return a board's points (n, 3) as they really are: misprinted, bent."""
    points = board.points_board
    middle = (points.max(0) + points.min(0)) / 2
    half = float(np.ptp(points, axis=0).max() / 2)
    x, y = (points - middle)[:, :2].T
    w = rng.normal(scale=0.004, size=3)
    lift = (w[0] * x * x + w[1] * x * y + w[2] * y * y) / half
    scale, aspect = 1 + rng.normal(scale=0.003), rng.normal(scale=0.001)
    return middle + scale * np.stack([x, (1 + aspect) * y, lift], -1)


class Lab:
    """A lab drawn from a seed."""

    def __init__(self, seed: int, pixel: float | None = None) -> None:
        """Draw arm, cameras and prints; corners are off by `pixel`, 0.1 to 0.2 px if None."""
        rng = np.random.default_rng([seed, 22])
        self.rng = rng
        self.pixel = rng.uniform(0.1, 0.2) if pixel is None else pixel
        self.arm = Arm.drawn(rng)
        wrist = se3.from_rt(
            turned(2, np.array(1.5))[:3, :3] @ se3.exp_so3(rng.normal(scale=0.08, size=3)),
            np.array([0.02, -0.06, 0.03]) + rng.normal(scale=0.005, size=3),
        )
        hand = UR3.forward(LOOKS_DOWN)
        aim = hand[:3, 3] * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.22]
        self.eyes = [_eye(rng, "wrist", wrist, (1280, 720), 900.0)]
        toward = np.arctan2(aim[1], aim[0])
        for name, turn in zip(NAMES[1:], (-1.1, 1.1, 0.1), strict=True):
            way = toward + turn + rng.normal(scale=0.1)
            away = np.array([np.cos(way), np.sin(way), 1.5]) * rng.uniform(0.5, 0.6)
            at = se3.look_at(aim + away, aim + rng.normal(scale=0.02, size=3), 0.0)
            self.eyes.append(_eye(rng, name, at, (1920, 1200), 1700.0))
        under = (hand @ wrist @ np.array([0, 0, 0.33, 1.0]))[:2]
        w, h = TABLE.size_m
        turn = turned(2, np.array(rng.uniform(-np.pi, np.pi)))
        self.table = (
            se3.from_translation([*under, 0.0])
            @ turn
            @ se3.from_rt(np.diag([1.0, -1.0, -1.0]), [-w / 2, h / 2, 0.0])
        )
        w, h = HELD.size_m
        # Behind the flange, to the side, its face up: z goes into the paper.
        tilt = se3.exp_so3(rng.normal(scale=0.08, size=3))
        self.held = se3.from_translation([0.03, 0.09, -0.02]) @ se3.from_rt(
            tilt, [-w / 2, 0.0, 0.0]
        )
        self.prints = [printed(rng, TABLE), printed(rng, HELD)]

    def joints(self, n: int) -> Array:
        """Return joints (n, 6) at which the camera in the hand sees the board on the table."""
        found: list[Array] = []
        while len(found) < n:
            q = LOOKS_DOWN + self.rng.normal(size=6) * SPREAD_RAD
            T = UR3.forward(q)
            if T[2, 3] > 0.12 and self._visible(0, se3.invert(T @ self.eyes[0].place) @ self.table,
                                                self.prints[0]) is not None:  # fmt: skip
                found.append(q)
        return np.array(found)

    def _visible(self, c: int, T_cam_board: Array, points: Array) -> Array | None:
        """Return pixels of a board's points, NaN outside; None where too little of it is seen."""
        normal = T_cam_board[:3, 2]
        centre = se3.transform(T_cam_board, points.mean(0)[None])[0]
        if normal @ centre < MOST_SLANT * np.linalg.norm(centre) or centre[2] < 0.1:
            return None
        eye = self.eyes[c]
        uv = eye.see(se3.transform(T_cam_board, points)).reshape(-1, 4, 2)
        size = np.array(eye.size) - 1
        inside = np.all((uv > 2) & (uv < size - 2), axis=(1, 2))
        if inside.mean() < SHARE_SEEN:
            return None
        return np.where(inside[:, None, None], uv, np.nan).reshape(-1, 2)

    def sight(self, c: int, b: int, hand: Array) -> Array | None:
        """Return pixels of a board in a camera when the hand is really there, without noise."""
        eye = self.eyes[c].place if c else hand @ self.eyes[0].place
        place = hand @ self.held if b else self.table
        return self._visible(c, se3.invert(eye) @ place, self.prints[b])

    def rig(
        self, views: int, cameras: tuple[str, ...] = NAMES, with_joints: bool = False
    ) -> tuple[Rig, Array]:
        """Return what is seen at some instants, and the joints (views, 6).

        A lab shows the same whichever cameras are asked for: the random numbers do not depend on
        them.
        """
        q = self.joints(views)
        sightings: list[Sighting] = []
        for i, joints in enumerate(q):
            hand = self.arm.pose(joints, self.rng)
            for c, eye in enumerate(self.eyes):
                for b in (0, 1):
                    board = (TABLE, HELD)[b]
                    noise = self.rng.normal(scale=self.pixel, size=(len(board.points_board), 2))
                    uv = self.sight(c, b, hand)
                    if uv is None or eye.name not in cameras or (c == 0 and b == 1):
                        continue
                    ids = np.flatnonzero(np.isfinite(uv[:, 0]))
                    sightings.append(
                        Sighting(
                            camera=cameras.index(eye.name), board=b, instant=i,
                            detection=TargetDetection(
                                point_ids=ids, uv=(uv + noise)[ids], image_size=eye.size
                            ),
                        )
                    )  # fmt: skip
        boards = (RigBoard(name="table", target=TABLE, place="table"),
                  RigBoard(name="held", target=HELD, place="hand"))  # fmt: skip
        seen = {s.board for s in sightings}
        return Rig(
            cameras=tuple(
                RigCamera(name=n, mount="hand" if n == "wrist" else "fixed") for n in cameras
            ),
            boards=boards if len(seen) > 1 else boards[:1],
            instants=tuple(
                Instant(name=f"{i:03d}", T_base_ee=UR3.forward(joints),
                        joints=joints if with_joints else None)
                for i, joints in enumerate(q)
            ),
            sightings=tuple(sightings),
        ), q  # fmt: skip
