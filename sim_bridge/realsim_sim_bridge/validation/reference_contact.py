"""An independent contact model: slow, explicit and simple, only to check the engines by.

It shares no code with them and none of their methods: no constraints, no iterations, no margins, no
mass floor. A finger's pad is its spheres, each a damped spring with a bristle for its friction; the
object is the triangles of its convex parts; everything moves in steps of 25 us
(`reference_loops`). The fingers are one coupled mass, which a drive pushes with the hand's force
until it reaches the closing speed.

The boxes behind the pads and the palm meet points of the object's surface, as stiff as a sphere
each. `docs/decisions/0048-an-independent-contact-model.md`.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from realsim import __version__
from realsim.arrays import Array, Int64, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.robots.hand import Hand
from realsim_sim_bridge.slip.world import (
    Closing,
    Engine,
    Grips,
    HandWorld,
    Meeting,
    Motion,
    PadModel,
    PairStates,
    Replay,
)
from realsim_sim_bridge.validation import reference_loops as loops

SPACING_M = 0.003
"""Greatest distance of the points with which an object meets the hand's boxes [m]."""
PRESSING_SPEED = 0.1
"""Speed at which the drive would close without resistance while loads are played [m/s]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ReferenceSettings:
    """How finely the contact model steps, and what it takes for granted."""

    step_s: float = 25e-6
    """Time step [s]: a hundredth of the vibration of 100 g between two pads of 200 kN/m."""
    load_s: float = 1e-3
    """Time for which a load stands [s]; a multiple of the step."""
    damping: float = 1.0
    """Damping of each contact, in units of the critical damping of its share of the object's
    mass."""
    tangent_share: float = 1.0
    """Stiffness of the bristles, in units of a sphere's."""
    drive_kg: float = 0.4
    """Reflected inertia of a finger's drive [kg]; chosen, as MuJoCo's is."""
    pairs_per_world: int = 64
    """Pairs of a world; they are played one after the other."""
    replay: Replay = field(default_factory=Replay)
    """At true speed."""


class ReferenceEngine(Engine):
    """The contact model as an engine of the slip test."""

    name = "reference"

    def __init__(self, settings: ReferenceSettings | None = None) -> None:
        """Take the settings."""
        self.settings = settings or ReferenceSettings()

    def version(self) -> str:
        """Return realsim's version, whose part it is."""
        return __version__

    def world(self, met: Meeting, grips: Grips) -> "ReferenceWorld":
        """Return a world with these pairs.

        Raises:
            InputError: the objects stand on something, the hand has no sphere pads, or a part of
                the object is flat.
        """
        if met.stand is not None:
            raise InputError(
                "the reference contact model closes on free objects and was given a table; give "
                "it trials without a stand."
            )
        return ReferenceWorld(met, grips, self.settings)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Surface:
    """Triangles of the hulls of an object's convex parts, one part after the other."""

    triangles: Array
    """(T, 3, 3) [m]."""
    normals: Array
    """(T, 4) outward unit normal n and d: n . x + d <= 0 inside [m]."""
    first: Int64
    """(P + 1,) where each part begins."""
    points: Array
    """(N, 3) of the surface, no farther apart than `SPACING_M` [m]."""

    @classmethod
    def of(cls, parts: list[Array]) -> "_Surface":
        """Return the hulls of parts, vertices (V, 3) each [m]; a flat one raises an InputError."""
        from scipy.spatial import ConvexHull, QhullError

        hulls: list[Any] = []
        for k, part in enumerate(parts):
            try:
                hulls.append(ConvexHull(part))
            except QhullError as error:
                raise InputError(
                    f"convex part {k} of {len(part)} points has no volume; at least four points "
                    "that are not in a plane are expected. Cut the object into convex parts anew."
                ) from error
        triangles = [p[h.simplices] for p, h in zip(parts, hulls, strict=True)]
        return cls(
            triangles=np.concatenate(triangles),
            normals=np.concatenate([h.equations for h in hulls]),
            first=np.cumsum([0, *(len(t) for t in triangles)]),
            points=_points(triangles, [h.equations for h in hulls]),
        )


def _points(triangles: list[Array], planes: list[Array]) -> Array:
    """Return points (N, 3) of the surface of parts, triangles (T, 3, 3) and planes (T, 4) each."""
    kept: list[Array] = []
    for part in triangles:
        found: list[Array] = []
        for corners in part:
            longest = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max()
            n = int(np.ceil(longest / SPACING_M))
            i, j = np.nonzero(np.add.outer(np.arange(n + 1), np.arange(n + 1)) <= n)
            found.append(np.stack([i, j, n - i - j], axis=-1) / n @ corners)
        points = np.unique(np.round(np.concatenate(found), 9), axis=0)
        hidden = np.zeros(len(points), dtype=np.bool_)
        for other in planes:
            hidden |= np.all(points @ other[:, :3].T + other[:, 3] < -loops.SEAM_M, axis=1)
        kept.append(points[~hidden])
    return np.unique(np.concatenate(kept), axis=0)


class ReferenceWorld(HandWorld):
    """K pairs, each a row of state (`reference_loops`) in its hand's axes."""

    def __init__(self, met: Meeting, grips: Grips, settings: ReferenceSettings) -> None:
        """Place the hands open and the objects where the grips say; see `ReferenceEngine.world`."""
        body, physics, geometry = met.body, met.physics, met.geometry
        pads = physics.pads
        if pads is None:
            raise InputError(
                "the reference contact model touches by sphere pads and was given none; give "
                "SlipPhysics its pads: PadModel.of(hand)."
            )
        self.dt, self._settings, self._physics = settings.load_s, settings, physics
        n = len(grips.openings_m)
        self.alive: Mask = np.ones(n, dtype=np.bool_)
        self._R_world_hand = grips.Ts_table_grasp[:, :3, :3]
        self._geometry = geometry
        T_obj_body, moments = body.principal_frame()
        T_body_obj = se3.invert(T_obj_body)
        self._surface = _Surface.of([se3.transform(T_body_obj, part) for part in body.parts])
        self._spheres, (self._boxes, self._sides) = _spheres(pads), _boxes(pads, geometry)
        fingers_kg = 2.0 * (pads.finger_mass_kg + settings.drive_kg)
        self._matter = np.array([body.mass_kg, *moments, fingers_kg, body.reach()])
        stiffness = pads.point_n_per_m
        share_kg = body.mass_kg / len(self._spheres)
        self._pad = np.array([
            stiffness, settings.tangent_share * stiffness,
            2.0 * settings.damping * np.sqrt(stiffness * share_kg),
            physics.friction, physics.force_n,
        ])  # fmt: skip
        self._arc = np.array([geometry.arc_radius_m, geometry.arc_axis_y_m])
        self._state = np.zeros((n, loops.SIZE))
        Ts = se3.invert(grips.Ts_obj_grasp) @ T_obj_body
        self._place(np.arange(n), Ts, np.zeros((n, 6)), grips.openings_m / 2.0, np.zeros(n))
        self._bristles = np.zeros((n, len(self._spheres), len(body.parts), 3))
        self._bristles_box = np.zeros((n, len(self._surface.points), len(self._boxes), 3))
        self._entered = np.full(self._bristles_box.shape[:3], -1)

    def __exit__(self, *_: object) -> None:
        """Hold nothing that has to be freed."""

    @property
    def energy_j(self) -> Array:
        """(K,) kinetic and stored energy, and the drive's: how far it can push, times its force."""
        lift = 2.0 * self._physics.force_n * self._state[:, loops.FINGER]
        return self._state[:, loops.ENERGY] + lift

    @property
    def deepest_m(self) -> Array:
        """(K,) the deepest that a sphere sank in so far [m]."""
        return self._state[:, loops.DEEPEST]

    def close(self, closing: Closing) -> Motion:
        """Close all hands on their weightless objects; see `HandWorld`."""
        sample = max(1, round(closing.sample_s / self.dt))
        arrival_s = self._state[:, loops.FINGER].max(initial=0.0) / closing.speed
        looks = int(np.ceil((arrival_s + closing.settle_s) / (sample * self.dt)))
        seen = np.full((len(self.alive), looks, loops.SIZE), np.nan)
        for k in np.nonzero(self.alive)[0].tolist():
            origin = self._state[k, :3].copy()
            for look in range(looks):
                before = self._state[k].copy()
                self._march(k, np.zeros((sample, 6)), sample, np.inf, closing, seen[k, look:])
                now = self._state[k]
                shift = np.abs(now - before)[[0, 1, 2, loops.FINGER]].max()
                pressed = (now[loops.FORCES] > self._physics.contact_n).all()
                lost = not np.linalg.norm(now[:3] - origin) <= closing.lost_m
                if lost or (pressed and shift < closing.settled_m):
                    break
        return self._motion(seen, np.arange(1, looks + 1) * sample)

    def play(self, wrenches: Array, sample: int, lost_m: float) -> Motion:
        """Apply wrenches (K, T, 6) and return what is seen; see `HandWorld`."""
        count = wrenches.shape[1]
        stops = np.append(np.arange(sample, count, sample), count)[: count and None]
        seen = np.full((len(self.alive), len(stops), loops.SIZE), np.nan)
        for k in np.nonzero(self.alive)[0].tolist():
            # v @ R turns into the hand's axes.
            turned = (wrenches[k].reshape(-1, 3) @ self._R_world_hand[k]).reshape(-1, 6)
            self._march(k, turned, sample, lost_m, None, seen[k])
        return self._motion(seen, stops)

    def states(self) -> PairStates:
        """Return where everything is now; NaN where removed."""
        rows = np.where(self.alive[:, None], self._state, np.nan)
        R = self._R_world_hand
        speeds = rows[:, loops.SPEEDS].reshape(-1, 2, 3)[:, ::-1] @ np.swapaxes(R, -1, -2)
        pairs = {
            name: np.repeat(rows[:, [column]], 2, axis=1)
            for name, column in (("fingers_m", loops.FINGER), ("finger_speeds", loops.FINGER_SPEED))
        }
        Ts = self._poses(rows[:, None])[:, 0]
        return PairStates(Ts_world_body=Ts, twists=speeds.reshape(-1, 6), **pairs)

    def put(self, states: PairStates) -> None:
        """Put pairs there, with straight bristles; rows of NaN stay."""
        k = np.nonzero(self.alive & np.isfinite(states.Ts_world_body[:, 0, 0]))[0]
        R = self._R_world_hand[k]
        Ts = se3.invert(se3.from_rt(R, np.zeros((len(k), 3)))) @ states.Ts_world_body[k]
        twists = (states.twists[k].reshape(-1, 2, 3) @ R).reshape(-1, 6)
        fingers, speeds = states.fingers_m[k].mean(axis=1), states.finger_speeds[k].mean(axis=1)
        self._place(k, Ts, twists, fingers, speeds)
        self._bristles[k] = self._bristles_box[k] = 0.0
        self._entered[k] = -1

    def settings(self) -> dict[str, float]:
        """Return what the model computes with."""
        friction, force_n = self._pad[3:].tolist()
        return {
            "finger_friction": friction,
            "object_friction": friction,
            "dt_s": self._settings.step_s,
            "object_mass_kg": float(self._matter[0]),
            "force_n": force_n,
            "pad_stiffness_n_per_m": 0.5 * len(self._spheres) * float(self._pad[0]),
            "contact_damping": float(self._pad[2]),
        }

    # --- between here and the loop ------------------------------------------------------------

    def _place(self, k: Int64, Ts: Array, twists: Array, fingers: Array, speeds: Array) -> None:
        """Put objects (n, 4, 4), twists (n, 6) and fingers (n,) of pairs k there, hand axes."""
        state = self._state
        state[k, :3] = Ts[:, :3, 3]
        state[k, loops.QUATERNION] = se3.quaternion_wxyz(Ts[:, :3, :3])
        state[k, loops.SPEEDS] = np.concatenate([twists[:, 3:], twists[:, :3]], axis=1)
        state[k, loops.FINGER], state[k, loops.FINGER_SPEED] = fingers, speeds
        state[k, loops.HEIGHT] = self._geometry.z_pad(2.0 * fingers)

    def _march(
        self, k: int, wrenches: Array, sample: int, lost_m: float, closing: Closing | None,
        seen: Array,
    ) -> None:  # fmt: skip
        """Move pair k under loads (T, 6) in the hand's axes; `closing` None = it is closed.

        The drive of fingers on an arc locks itself: once closed they stay at their height.
        """
        s, surface = self._settings, self._surface
        loops.march(
            self._state[k], self._bristles[k], self._bristles_box[k], self._entered[k],
            np.ascontiguousarray(wrenches),
            round(s.load_s / s.step_s), sample, s.step_s, lost_m, seen,
            closing.drag_per_s if closing else 0.0, closing.speed if closing else PRESSING_SPEED,
            self._matter, self._pad, self._spheres, self._boxes, self._sides, surface.triangles,
            surface.normals, surface.first, surface.points, self._arc if closing else np.zeros(2),
        )  # fmt: skip

    def _poses(self, rows: Array) -> Array:
        """Return T_world_body (K, S, 4, 4) of states (K, S, SIZE); NaN where they are."""
        known = np.isfinite(rows[..., :1])
        turns = np.where(known, rows[..., loops.QUATERNION], [1.0, 0.0, 0.0, 0.0])
        R = self._R_world_hand[:, None]
        at = np.einsum("kij,ksj->ksi", R[:, 0], rows[..., :3])
        Ts = se3.from_rt(R @ se3.from_quaternion_wxyz(turns), at)
        return np.where(known[..., None], Ts, np.nan)

    def _motion(self, seen: Array, stops: Int64) -> Motion:
        """Return what was seen (K, S, SIZE) after so many loads (S,)."""
        return Motion(
            Ts_world_body=self._poses(seen),
            finger_n=seen[..., loops.FORCES],
            times_s=stops.astype(np.float64) * self.dt,
        )


def _spheres(pads: PadModel) -> Array:
    """Return the spheres (S, 5) of the closed hand: centre and radius [m], finger's side."""
    radius = pads.sphere_radius_m
    rows = np.insert(np.insert(pads.centers_xz(), 1, radius, axis=1), 3, radius, axis=1)
    return np.concatenate([np.insert(rows * [1.0, y, 1.0, 1.0], 4, y, axis=1) for y in (1.0, -1.0)])


def _boxes(pads: PadModel, hand: Hand) -> tuple[Array, Array]:
    """Return the boxes (B, 2, 3) of the closed hand [m], and each one's finger (B,) or 0."""
    fingers = np.array(hand.finger_boxes)
    fingers[:, 0, 1] = np.maximum(fingers[:, 0, 1], pads.protrusion_m)
    other = fingers.copy()
    other[:, 0, 1], other[:, 1, 1] = -fingers[:, 1, 1], -fingers[:, 0, 1]
    palm = np.array(hand.palm_boxes)
    sides = np.repeat([0.0, 1.0, -1.0], [len(palm), len(fingers), len(fingers)])
    return np.concatenate([palm, fingers, other]), sides
