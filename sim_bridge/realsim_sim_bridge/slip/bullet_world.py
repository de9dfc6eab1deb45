"""PyBullet as an engine of the slip test: K grasps, one after the other in one pair."""

from typing import TYPE_CHECKING

import numpy as np

from realsim.arrays import Array, Mask
from realsim.geometry import se3
from realsim_sim_bridge.slip.bullet_pair import BulletPair
from realsim_sim_bridge.slip.world import (
    Closing,
    Engine,
    Grips,
    HandWorld,
    Meeting,
    Motion,
    PairStates,
)

if TYPE_CHECKING:
    from realsim_sim_bridge.slip.engines import BulletSettings

_PLACE, _AXES = np.s_[:3, 3], np.s_[:3, :3]


class BulletEngine(Engine):
    """PyBullet with its settings; keeps the pair of the last body."""

    name = "pybullet"

    def __init__(self, settings: "BulletSettings") -> None:
        """Keep the settings."""
        self.settings = settings
        self._kept: BulletPair | None = None

    def world(self, met: Meeting, grips: Grips) -> "BulletWorld":
        """Return a world with these pairs; their pair is built if it is another than the last."""
        pair = self._kept
        if pair is None or not _same(pair.met, met):
            pair = self._kept = BulletPair(met, self.settings)
        return BulletWorld(pair, grips)


def _same(a: Meeting, b: Meeting) -> bool:
    """Return whether the very body and stand meet, under equal laws in equal hands."""
    equal = (a.physics, a.geometry) == (b.physics, b.geometry)
    return equal and a.body is b.body and a.stand is b.stand


class BulletWorld(HandWorld):
    """K pairs of hand and object; a `HandWorld`. Other worlds may be played in the same pair."""

    def __init__(self, pair: BulletPair, grips: Grips) -> None:
        """Put nothing into the engine yet; the interface is described in `world.py`."""
        n = len(grips.openings_m)
        self._pair, self._physics = pair, pair.met.physics
        self.dt = pair.dt
        self._Ts_hand_table = se3.invert(grips.Ts_table_grasp)
        self._R_world_hand = grips.Ts_table_grasp[:, :3, :3]
        self._Ts_hand_body = se3.invert(grips.Ts_obj_grasp) @ pair.met.body.principal_frame()[0]
        self._twists = np.zeros((n, 6))
        self._fingers = np.repeat(grips.openings_m[:, None] / 2.0, 2, axis=1)
        self._speeds = np.zeros((n, 2))
        self.alive: Mask = np.ones(n, dtype=np.bool_)

    def __exit__(self, *_: object) -> None:
        """Nothing is held here: the engine keeps its pair for the next world."""

    def close(self, closing: Closing) -> Motion:
        """Close all hands; see `HandWorld`. Each pair ends where it came to rest."""
        sample = max(1, round(closing.sample_s / self.dt))
        pair = self._pair
        pair.drag(closing.drag_per_s if pair.met.stand is None else 0.0)
        pair.anchor(False)
        seen = [
            self._close(k, closing, sample) if self.alive[k] else [] for k in range(len(self.alive))
        ]
        pair.drag(0.0)
        pair.place_stand(None)
        pair.anchor(True)
        return self._motion(seen, max((len(s) for s in seen), default=0), sample)

    def _close(self, k: int, closing: Closing, sample: int) -> list[tuple[Array, Array]]:
        """Close hand k and return what is seen every `sample` steps."""
        pair = self._pair
        pair.place_stand(self._Ts_hand_table[k])
        self._take(k)
        pair.drive(closing.speed)
        down = -self._R_world_hand[k, 2]
        duration_s = float(self._fingers[k].max()) / closing.speed + closing.settle_s
        most = 0 if pair.met.stand is None else round(closing.release_s / (sample * self.dt))
        sunk, weight = -1, (pair.weights_n[0] * down).tolist()
        before, fingers = self._Ts_hand_body[k], self._fingers[k]
        start = before[:3, 3]
        seen: list[tuple[Array, Array]] = []
        while sunk < most:
            for step in range(1, sample + 1):
                if sunk >= 0:
                    far = closing.release_speed * self.dt * (sunk * sample + step)
                    pair.sink_stand(far * down)
                pair.follow_arc()
                if pair.met.stand is not None:
                    pair.push([0.0, 0.0, 0.0], weight)
                pair.engine.stepSimulation()
            seen.append((pair.pose(), pair.finger_forces()))
            at, forces = seen[-1]
            now = pair.fingers()[0]
            shift, turn = (
                float(np.linalg.norm(at[rows] - before[rows])) for rows in (_PLACE, _AXES)
            )
            # |R - R0| is 1.41 times the angle for small ones.
            moved = max(shift + turn * pair.reach_m, float(np.abs(now - fingers).max()))
            pressed = bool(np.all(forces > self._physics.contact_n))
            rests = pressed and moved < closing.settled_m
            if float(np.linalg.norm(at[_PLACE] - start)) > closing.lost_m or (rests and sunk >= 0):
                break
            if sunk >= 0 or rests or len(seen) * sample >= duration_s / self.dt:
                if not pressed and sunk < 0:
                    break
                sunk, weight = sunk + 1, (pair.weights_n[1] * down).tolist()
            before, fingers = at, now
        self._leave(k)
        return seen

    def play(self, wrenches: Array, sample: int, lost_m: float) -> Motion:
        """Apply wrenches (K, T, 6) and return what is seen; see `HandWorld`."""
        looks = -(-wrenches.shape[1] // sample)
        # The hand's axes are the engine's.
        torques, forces = (
            np.einsum("kji,ktj->kti", self._R_world_hand, w)
            for w in (wrenches[..., :3], wrenches[..., 3:])
        )
        seen = [
            self._play(k, torques[k].tolist(), forces[k].tolist(), sample, lost_m)
            if self.alive[k]
            else []
            for k in range(len(self.alive))
        ]
        return self._motion(seen, looks, sample, wrenches.shape[1])

    def _play(
        self,
        k: int,
        torques: list[list[float]],
        forces: list[list[float]],
        sample: int,
        lost_m: float,
    ) -> list[tuple[Array, Array]]:
        """Play pair k and return what is seen every `sample` steps, until it is lost."""
        pair = self._pair
        self._take(k)
        pair.drive(Closing().speed)
        start = self._Ts_hand_body[k, :3, 3]
        seen: list[tuple[Array, Array]] = []
        for t, (torque, force) in enumerate(zip(torques, forces, strict=True), 1):
            pair.push(torque, force)
            pair.engine.stepSimulation()
            if t % sample == 0 or t == len(torques):
                seen.append((pair.pose(), pair.finger_forces()))
                if float(np.linalg.norm(seen[-1][0][:3, 3] - start)) > lost_m:
                    break
        self._leave(k)
        return seen

    def states(self) -> PairStates:
        """Return where everything is; see `HandWorld`."""
        R = self._R_world_hand
        gone = ~self.alive
        Ts = self._hands() @ self._Ts_hand_body
        turned = np.einsum("kij,kpj->kpi", R, self._twists.reshape(-1, 2, 3)).reshape(-1, 6)
        fingers, speeds = self._fingers.copy(), self._speeds.copy()
        for array in (Ts, turned, fingers, speeds):
            array[gone] = np.nan
        return PairStates(Ts_world_body=Ts, twists=turned, fingers_m=fingers, finger_speeds=speeds)

    def put(self, states: PairStates) -> None:
        """Put pairs there; see `HandWorld`."""
        there = ~np.isnan(states.Ts_world_body[:, 0, 0]) & self.alive
        Ts = se3.invert(self._hands()[there]) @ states.Ts_world_body[there]
        self._Ts_hand_body[there] = Ts
        turned = np.einsum(
            "kji,kpj->kpi", self._R_world_hand[there], states.twists[there].reshape(-1, 2, 3)
        )
        self._twists[there] = turned.reshape(-1, 6)
        self._fingers[there], self._speeds[there] = (
            states.fingers_m[there],
            states.finger_speeds[there],
        )

    def settings(self) -> dict[str, float]:
        """Return the engine's own settings; see `HandWorld`."""
        return self._pair.settings()

    # --- between here and the engine ----------------------------------------------------------

    def _take(self, k: int) -> None:
        """Put pair k into the engine."""
        self._pair.put(self._Ts_hand_body[k], self._twists[k], self._fingers[k], self._speeds[k])

    def _leave(self, k: int) -> None:
        """Note where pair k is now."""
        self._Ts_hand_body[k], self._twists[k] = self._pair.pose(), self._pair.twist()
        self._fingers[k], self._speeds[k] = self._pair.fingers()

    def _hands(self) -> Array:
        """Return T_world_hand (K, 4, 4)."""
        return se3.from_rt(self._R_world_hand, np.zeros((len(self.alive), 3)))

    def _motion(
        self,
        seen: list[list[tuple[Array, Array]]],
        looks: int,
        sample: int,
        steps: int | None = None,
    ) -> Motion:
        """Return what was seen of all pairs; NaN where nothing was."""
        n = len(self.alive)
        Ts, forces = np.full((n, looks, 4, 4), np.nan), np.full((n, looks, 2), np.nan)
        for k, looked in enumerate(seen):
            for i, (T, force) in enumerate(looked):
                Ts[k, i], forces[k, i] = T, force
        times = np.minimum(sample * np.arange(1, looks + 1), steps or sample * looks) * self.dt
        return Motion(Ts_world_body=self._hands()[:, None] @ Ts, finger_n=forces, times_s=times)
