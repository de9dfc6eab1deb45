"""The slip test's worlds in MuJoCo: all pairs share one compiled model and are rolled out in C.

A pair's result does not depend on which others it is rolled out with: every rollout begins with the
pair's own state and a cold solver.
"""

import copy
import hashlib
from collections import OrderedDict
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.arrays import Array, Mask, Rows
from realsim.errors import InputError
from realsim.geometry import se3
from realsim_sim_bridge.slip import mujoco_state
from realsim_sim_bridge.slip.mujoco_approach import advanced_fingers
from realsim_sim_bridge.slip.mujoco_model import (
    OBJECT,
    PairModel,
    compile_pair,
    load_mujoco,
    lock_lifts,
)
from realsim_sim_bridge.slip.mujoco_state import Samples, read_settings, set_drag, set_stand
from realsim_sim_bridge.slip.stand import Stand
from realsim_sim_bridge.slip.world import (
    Closing,
    Engine,
    Grips,
    HandWorld,
    Meeting,
    Motion,
    PairStates,
    SlipBody,
    SlipPhysics,
)

if TYPE_CHECKING:
    from realsim_sim_bridge.slip.engines import MujocoSettings

MODELS_KEPT = 4
"""Compiled models that an engine keeps; a scene's objects are tested one after the other."""
PIECE_STEPS = 100
"""Steps of one rollout: loads and states of 48 pairs then take 2 MB."""

SLOWEST = 0.01
"""Least closing speed [m/s]: between two looks, 0.05 s, the loaded drive loses 0.7 mm/s."""
PRESSING_SPEED = 0.1
"""Speed of the drive while loads are played [m/s]; fingers that press do not follow it."""


class MujocoEngine(Engine):
    """MuJoCo; keeps the compiled models of the last objects."""

    name = "mujoco"

    def __init__(self, settings: "MujocoSettings") -> None:
        """Take the settings; nothing is compiled yet."""
        self.settings = settings
        self._models: OrderedDict[str, PairModel] = OrderedDict()

    def world(self, met: Meeting, grips: Grips) -> HandWorld:
        """Return a world with these pairs.

        Raises:
            InputError: MuJoCo refuses the object.
        """
        key = _content(met.body, met.physics, met.geometry, met.stand)
        if key not in self._models:
            self._models[key] = compile_pair(met, self.settings)
        self._models.move_to_end(key)
        while len(self._models) > MODELS_KEPT:
            self._models.popitem(last=False)
        return MujocoWorld(self._models[key], grips, met.physics, self.settings)


class MujocoWorld(HandWorld):
    """K pairs, each a row of state; see `mujoco_state`."""

    def __init__(
        self, pair: PairModel, grips: Grips, physics: SlipPhysics, settings: "MujocoSettings"
    ) -> None:
        """Place the hands open and the objects where the grips say."""
        mujoco = load_mujoco()
        self._pair, self._physics, self._settings = pair, physics, settings
        self.dt = settings.step_s
        self.alive = np.ones(len(grips.openings_m), dtype=np.bool_)
        # A copy, because the drag is set in it.
        self._model: Any = copy.copy(pair.model)
        self._data: Any = mujoco.MjData(self._model)
        self._rollout: Any = mujoco.rollout.Rollout(nthread=0)
        state = mujoco.mjtState
        self._control_spec = int(
            state.mjSTATE_XFRC_APPLIED | state.mjSTATE_MOCAP_POS | state.mjSTATE_MOCAP_QUAT
        )
        self._control_width = int(mujoco.mj_stateSize(self._model, self._control_spec))
        first = 6 * int(self._model.body(OBJECT).id)
        self._load = slice(first, first + 6)
        self._memory: dict[str, Array] = {}
        self._speed = PRESSING_SPEED
        self._Rs_world_hand = np.ascontiguousarray(grips.Ts_table_grasp[:, :3, :3])
        self._Ts_obj_grasp = grips.Ts_obj_grasp
        # Where the table is, behind the loads in the control: nothing where there is none.
        T_grasp_table = se3.invert(grips.Ts_table_grasp)
        quaternions = se3.quaternion_wxyz(T_grasp_table[:, :3, :3])
        stands = np.concatenate([T_grasp_table[:, :3, 3], quaternions], axis=1)
        self._stands = stands[:, : 7 * int(self._model.nmocap)]
        Ts_grasp_body = se3.invert(grips.Ts_obj_grasp) @ pair.T_obj_body
        self._rows = mujoco_state.rows_at(Ts_grasp_body, grips.openings_m / 2.0)
        set_stand(self._model, False)
        self._lock(True)
        self._open = self.alive.copy()
        """Hands that have not been closed or put anywhere yet."""

    def __exit__(self, *_: object) -> None:
        """Free the engine's memory."""
        self._rollout.close()
        self._memory.clear()
        del self._data, self._model

    # --- what happens in it -------------------------------------------------------------------

    def close(self, closing: Closing) -> Motion:
        """Close all hands on their objects and press with the hand's force from then.

        Hands that are open start near the object (`mujoco_approach`). A pair ends when it rests or
        its time is up, and what was seen last of it is seen from then on, unless it was lost.

        Raises:
            InputError: the closing speed is too low.
        """
        if not closing.speed >= SLOWEST:
            raise InputError(
                f"the fingers cannot close at {closing.speed} m/s in MuJoCo, where their drive "
                f"slows down under load; {SLOWEST} m/s or more is expected."
            )
        self._start_near_objects()
        self._speed = closing.speed
        stand = self._pair.stand
        set_drag(self._model, closing.drag_per_s if stand is None else 0.0)
        set_stand(self._model, stand is not None)
        self._lock(False)
        every = max(1, round(closing.sample_s / self.dt))
        arrival_s = self._rows[:, mujoco_state.FINGERS].max(axis=1) / closing.speed
        looks = np.ceil((arrival_s + closing.settle_s) / (every * self.dt)).astype(np.int64)
        origin = self._rows[:, mujoco_state.POSITION].copy()
        count = int(looks[self.alive].max()) if self.alive.any() else 0
        # Looks at a table that sinks: of each pair from when it rests, or has had its time.
        most = 0 if stand is None else round(closing.release_s / (every * self.dt))
        sunk = np.zeros(len(self._rows), dtype=np.int64)
        steps = np.arange(1, every + 1)
        seen = Samples.empty(
            len(self._rows), _times(np.arange(1, count + most + 1) * every, self.dt)
        )
        going, lost, standing = self.alive.copy(), ~self.alive, self.alive.copy()
        last = np.zeros(len(going), dtype=np.int64)
        for look in range(count + most):
            k = np.nonzero(going)[0]
            if len(k) == 0:
                break
            before = self._rows[k]
            down = (every * sunk[k, None] + steps) * ~standing[k, None]
            states, forces, sound = self._run(
                k,
                every,
                None if stand is None else self._weights(stand, standing[k]),
                np.asarray(closing.release_speed * self.dt * down, dtype=np.float64),
            )
            seen.rows[k[sound], look] = states[sound, -1]
            seen.finger_n[k[sound], look] = forces[sound, -1]
            last[k] = look
            sunk[k] += ~standing[k]
            moved = mujoco_state.moved_m(before, self._rows[k], self._pair.reach_m)
            pressed = (forces[:, -1] > self._physics.contact_n).all(axis=1)
            shift = np.linalg.norm(self._rows[k, mujoco_state.POSITION] - origin[k], axis=1)
            lost[k] = (shift > closing.lost_m) | ~sound
            late = np.where(standing[k], look + 1 >= looks[k], sunk[k] >= most)
            done = late | ((moved < closing.settled_m) & pressed)
            ends = done & (~standing[k] | ~pressed | (most == 0))
            going[k] = ~lost[k] & ~ends
            standing[k] &= ~done
        set_drag(self._model, 0.0)
        set_stand(self._model, False)
        self._lock(True)
        self._speed = PRESSING_SPEED
        return seen.held(last, ~lost).motion(self._Rs_world_hand)

    def play(self, wrenches: Array, sample: int, lost_m: float) -> Motion:
        """Apply wrenches (K, T, 6), one a time step, and return what is seen every `sample` steps.

        A pair whose object moved more than `lost_m` [m] is stopped soon after; its later samples
        are NaN.

        Raises:
            InputError: the wrenches do not fit the pairs, or are not numbers.
        """
        self._check(wrenches, sample)
        count = wrenches.shape[1]
        stops = np.append(np.arange(sample, count, sample), count)[: count and None]
        seen = Samples.empty(len(self._rows), _times(stops, self.dt))
        origin = self._rows[:, mujoco_state.POSITION].copy()
        going, piece = self.alive.copy(), sample * max(1, PIECE_STEPS // sample)
        for first in range(0, count, piece):
            k = np.nonzero(going)[0]
            if len(k) == 0:
                break
            steps = min(piece, count - first)
            states, forces, sound = self._run(k, steps, wrenches[k, first : first + steps])
            here = np.nonzero((stops > first) & (stops <= first + steps))[0]
            at = stops[here] - first - 1
            seen.rows[np.ix_(k[sound], here)] = states[sound][:, at]
            seen.finger_n[np.ix_(k[sound], here)] = forces[sound][:, at]
            shift = states[:, at, mujoco_state.POSITION] - origin[k, None]
            going[k] = sound & (np.linalg.norm(shift, axis=-1) <= lost_m).all(axis=1)
        return seen.motion(self._Rs_world_hand)

    def states(self) -> PairStates:
        """Return where everything is now; NaN where removed."""
        rows = np.where(self.alive[:, None], self._rows, np.nan)
        return mujoco_state.pair_states(rows, self._Rs_world_hand)

    def put(self, states: PairStates) -> None:
        """Put everything there, with fingers that press with the hand's force.

        Rows that are NaN stay as they are, and so do pairs that have been removed.
        """
        given = self.alive & np.isfinite(states.Ts_world_body[:, 0, 0])
        rows = mujoco_state.rows_of(states.rows(given), self._Rs_world_hand[given])
        self._rows[given] = rows
        self._open[given] = False

    def settings(self) -> dict[str, float]:
        """Return what the compiled model says its settings are."""
        return read_settings(self._model)

    # --- how ----------------------------------------------------------------------------------

    def _start_near_objects(self) -> None:
        """Move fingers that are still open to where they nearly touch."""
        k = np.nonzero(self._open & self.alive)[0]
        self._rows[k, mujoco_state.FINGERS] = advanced_fingers(
            self._pair.triangles_obj,
            self._Ts_obj_grasp[k],
            self._rows[k, mujoco_state.FINGERS.start] * 2.0,
            self._pair.geometry,
        )[:, None]
        self._open[k] = False

    def _weights(self, stand: Stand, standing: Mask) -> Array:
        """Return the objects' weights as wrenches (n, 1, 6): see `Stand` for whose."""
        weights = np.zeros((len(standing), 1, 6))
        simulated = float(self._model.body(OBJECT).mass[0])
        weights[:, 0, 5] = -stand.gravity * np.where(standing, simulated, self._pair.mass_kg)
        return weights

    def _lock(self, locked: bool) -> None:
        """Hold the height of fingers on an arc, or let it follow."""
        lock_lifts(self._model, locked, self._settings)
        self._locked = locked

    def _with_lifts(self, rows: Array) -> Array:
        """Return MuJoCo's own rows of state (K, 20 + 2 F) of rows (K, 20): heights by the arc."""
        pair = self._pair
        if pair.lifting is None:
            return rows
        full = np.empty((len(rows), len(pair.plain) + pair.lifts.size))
        full[:, pair.plain] = rows
        y, law = rows[:, mujoco_state.FINGERS], np.polynomial.Polynomial(pair.lifting)
        full[:, pair.lifts[0]] = law(y)
        speeds = 0.0 if self._locked else law.deriv()(y) * rows[:, mujoco_state.FINGER_SPEEDS]
        full[:, pair.lifts[1]] = speeds
        return full

    def _run(
        self, k: Rows, steps: int, wrenches: Array | None, sunk_m: Array | None = None
    ) -> tuple[Array, Array, Mask]:
        """Roll pairs k out and keep where they end.

        Args:
            k: (n,) numbers of the pairs.
            steps: how many.
            wrenches: (n, steps, 6) or (n, 1, 6) torque and force, world axes; None = no load.
            sunk_m: (n, steps) how far the table has sunk [m]; None = not at all.

        Returns:
            state rows (n, steps, 20), normal forces of the fingers (n, steps, 2) [N] and whether
            MuJoCo went through without a warning (n,). Pairs with one stay where they were. The
            arrays are overwritten by the next call.
        """
        n = len(k)
        control = self._space("control", n, steps, self._control_width)
        if wrenches is None:
            control[..., self._load] = 0.0
        else:
            R = self._Rs_world_hand[k]
            # v @ R turns into the hand's axes; MuJoCo takes the force first.
            control[..., self._load.start : self._load.stop - 3] = wrenches[..., 3:] @ R
            control[..., self._load.start + 3 : self._load.stop] = wrenches[..., :3] @ R
        stands = control[..., self._control_width - self._stands.shape[1] :]
        stands[:] = self._stands[k, None]
        if sunk_m is not None and self._stands.size:
            stands[..., :3] -= sunk_m[..., None] * self._Rs_world_hand[k, None, 2]
        pair = self._pair
        states = self._space("states", n, steps, len(pair.plain) + pair.lifts.size)
        forces = self._space("forces", n, steps, 2)
        begin = self._rows[k]
        begin[:, mujoco_state.TIME] = begin[:, mujoco_state.CARRIAGE] = 0.0
        begin[:, mujoco_state.CARRIAGE_SPEED] = -self._speed
        self._rollout.rollout(
            [self._model] * n,
            [self._data],
            self._with_lifts(begin),
            control,
            control_spec=self._control_spec,
            skip_checks=True,
            nstep=steps,
            state=states,
            sensordata=forces,
        )
        if pair.lifting is not None:
            states = states[..., pair.plain]
        # A rollout stops the clock at a warning and repeats the state from there.
        late = np.abs(states[:, -1, mujoco_state.TIME] - steps * self.dt) > 0.5 * self.dt
        sound = ~late & np.isfinite(states[:, -1]).all(axis=1)
        self._rows[k[sound]] = states[sound, -1]
        return states, forces, sound

    def _space(self, name: str, n: int, steps: int, width: int) -> Array:
        """Return an array (n, steps, width) in memory that is used again: fresh pages are dear."""
        size = n * steps * width
        if name not in self._memory or self._memory[name].size < size:
            self._memory[name] = np.zeros(len(self._rows) * max(steps, PIECE_STEPS) * width)
        return self._memory[name][:size].reshape(n, steps, width)

    def _check(self, wrenches: Array, sample: int) -> None:
        """Raise if the loads are not one finite wrench per pair and step."""
        if wrenches.ndim != 3 or wrenches.shape[::2] != (len(self._rows), 6) or sample < 1:
            raise InputError(
                f"loads of shape {wrenches.shape}, sampled every {sample} steps, cannot be played: "
                f"({len(self._rows)}, steps, 6), sampled every 1 step or more, is expected."
            )
        bad = self.alive & ~np.isfinite(wrenches).all(axis=(1, 2))
        if bad.any():
            raise InputError(
                f"the loads of pair {int(np.argmax(bad))} are not all numbers; check the mass, the "
                "inertia and the motion they were computed from."
            )


def _times(steps: Rows, dt: float) -> Array:
    """Return the times (S,) [s] after so many steps."""
    return steps.astype(np.float64) * dt


def _content(*parts: object) -> str:
    """Return a digest of what a model is compiled from."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, SlipBody | Stand):
            for field in fields(part):
                value: Any = getattr(part, field.name)
                arrays = value if isinstance(value, tuple) else (value,)  # pyright: ignore[reportUnknownVariableType]
                for array in arrays:  # pyright: ignore[reportUnknownVariableType]
                    content = np.ascontiguousarray(array)
                    digest.update(str(content.shape).encode() + content.tobytes())
        else:
            digest.update(repr(part).encode())
    return digest.hexdigest()
