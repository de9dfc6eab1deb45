"""Objects dropped on a table until they rest, and the proof that they do.

Objects are let go in waves, so that they land on each other. Then the engine takes the Robot
School's settings, and from the poses found there a second settle in a fresh world must move no
point by more than `stays_m`; until it does, its end is where the next begins.

The engine in which objects fall: a table that ends at its rim, and bodies that come and go.

Everything is in the table's frame. A body's frame in the engine is its principal one, at its centre
of mass. Settings are given one kind a call, because damping and friction in one call lose each
other, and the mass is read back.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from realsim import interop
from realsim.arrays import Array
from realsim.errors import RealsimError
from realsim.geometry import se3
from realsim_sim_bridge.slip.bullet_shapes import drawn_in_shape, require_taken, settings_in
from realsim_sim_bridge.slip.world import SlipBody
from realsim_sim_bridge.table_scenes.config import DropConfig
from realsim_sim_bridge.table_scenes.tables import TableModel

GRAVITY = 9.81
"""[m/s^2]."""
PLATE_M = 0.5
"""Thickness of the table top in the engine [m]: deeper than anything sinks, so that it is pushed
out upwards."""


@dataclass(frozen=True, eq=False, slots=True)
class _Body:
    """A body in the engine."""

    number: int
    T_body_obj: Array
    hull: Array
    """(V, 3) corners of its parts in the object's frame [m]."""


class DropWorld:
    """A table and the bodies on it; leaving the context frees the engine."""

    def __init__(self, table: TableModel, config: DropConfig) -> None:
        """Build the table."""
        self.config = config
        self.bodies: dict[int, _Body] = {}
        """Key of an object -> its body."""
        self._engine = interop.pybullet_client()
        self._folder = tempfile.TemporaryDirectory(prefix="realsim_drop_")
        self._shapes = 0
        self._rolling = 0.0
        self._rate_hz = 0.0
        self.falling()
        self._engine.setGravity(0.0, 0.0, -GRAVITY)
        rim = table.outline
        plate = np.concatenate(
            [np.column_stack([rim, np.full(len(rim), z)]) for z in (-PLATE_M, 0.0)]
        )
        self._statics = [self._static([plate])]
        self._statics += [self._static([rim]) for rim in table.rims]

    def __enter__(self) -> "DropWorld":
        """Return the world."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the engine."""
        self._engine.disconnect()
        self._folder.cleanup()

    # --- settings -----------------------------------------------------------------------------

    def falling(self) -> None:
        """Take the settings for falling: fewer steps, and balls that stop rolling."""
        self._set(self.config.rate_hz, self.config.iterations, self.config.rolling)

    def resting(self) -> None:
        """Take the Robot School's settings: finer steps, no rolling friction, no damping."""
        self._set(self.config.rest_rate_hz, self.config.rest_iterations, 0.0)

    def _set(self, rate_hz: float, iterations: int, rolling: float) -> None:
        self._engine.setPhysicsEngineParameter(
            fixedTimeStep=1.0 / rate_hz, numSolverIterations=iterations, numSubSteps=0,
            deterministicOverlappingPairs=1, solverResidualThreshold=0.0,
        )  # fmt: skip
        found = self._engine.getPhysicsEngineParameters()
        if abs(float(found["fixedTimeStep"]) * rate_hz - 1.0) > 1e-9:
            raise RealsimError(f"PyBullet refused {rate_hz:g} steps a second.")
        self._rate_hz, self._rolling = rate_hz, rolling
        for body in self.bodies.values():
            self._roll(body.number)

    def _roll(self, number: int) -> None:
        damping = 0.04 if self._rolling > 0 else 0.0  # Bullet's own, while falling
        self._engine.changeDynamics(number, -1, linearDamping=damping, angularDamping=damping)
        self._engine.changeDynamics(
            number, -1, rollingFriction=self._rolling, spinningFriction=self._rolling
        )

    # --- bodies -------------------------------------------------------------------------------

    def _shape(self, parts: list[Array]) -> tuple[int, float]:
        """Return a collision shape of convex parts and the margin that makes it as large."""
        self._shapes += 1
        path = Path(self._folder.name) / f"shape{self._shapes}.obj"
        return drawn_in_shape(self._engine, path, parts, self.config.margin_m)

    def _static(self, parts: list[Array]) -> int:
        shape, margin = self._shape(parts)
        body: int = self._engine.createMultiBody(0.0, shape)
        self._engine.changeDynamics(body, -1, collisionMargin=margin)
        self._rough(body)
        return body

    def _rough(self, body: int) -> None:
        self._engine.changeDynamics(
            body, -1, lateralFriction=float(np.sqrt(self.config.friction)), restitution=0.0
        )

    def add(self, key: int, solid: SlipBody, T_table_obj: Array) -> None:
        """Put an object somewhere, at rest."""
        T_obj_body, moments = solid.principal_frame()
        T_body_obj = se3.invert(T_obj_body)
        shape, margin = self._shape([se3.transform(T_body_obj, p) for p in solid.parts])
        position, xyzw = interop.pybullet_from_T(T_table_obj @ T_obj_body)
        number: int = self._engine.createMultiBody(solid.mass_kg, shape, -1, position, xyzw)
        self._engine.changeDynamics(number, -1, collisionMargin=margin)
        self._engine.changeDynamics(
            number, -1, mass=solid.mass_kg, localInertiaDiagonal=moments.tolist()
        )
        self._rough(number)
        self._roll(number)
        require_taken(settings_in(self._engine, number), {"mass": solid.mass_kg}, f"object {key}")
        self.bodies[key] = _Body(number, T_body_obj, np.concatenate(solid.parts))

    def remove(self, key: int) -> None:
        """Take an object away."""
        self._engine.removeBody(self.bodies.pop(key).number)

    # --- what happens -------------------------------------------------------------------------

    @property
    def dt(self) -> float:
        """Time of a step [s]."""
        return 1.0 / self._rate_hz

    def step(self, seconds: float) -> None:
        """Let time pass [s], in whole steps, one at least."""
        for _ in range(max(1, round(seconds * self._rate_hz))):
            self._engine.stepSimulation()

    def pose(self, key: int) -> Array:
        """Return T_table_obj (4, 4) of an object [m]."""
        body = self.bodies[key]
        position, xyzw = self._engine.getBasePositionAndOrientation(body.number)
        return interop.T_from_pybullet(position, xyzw) @ body.T_body_obj

    def points(self, key: int) -> Array:
        """Return the corners (V, 3) of an object's convex parts where it is [m]."""
        return se3.transform(self.pose(key), self.bodies[key].hull)

    def heights(self) -> dict[int, float]:
        """Return the height of every object's centre of mass [m]."""
        engine = self._engine
        return {
            k: float(engine.getBasePositionAndOrientation(b.number)[0][2])
            for k, b in self.bodies.items()
        }

    def speeds(self) -> dict[int, tuple[float, float]]:
        """Return speed [m/s] and turning [rad/s] of every object."""
        out: dict[int, tuple[float, float]] = {}
        for key, body in self.bodies.items():
            linear, angular = self._engine.getBaseVelocity(body.number)
            out[key] = float(np.linalg.norm(linear)), float(np.linalg.norm(angular))
        return out

    def deepest(self) -> tuple[float, int, int]:
        """Return the greatest penetration [m] and the two objects; -1 is the table."""
        worst = (0.0, -1, -1)
        rows = [(-1, n) for n in self._statics] + [(k, b.number) for k, b in self.bodies.items()]
        for i, (key_a, a) in enumerate(rows):
            for key_b, b in rows[max(i + 1, len(self._statics)) :]:
                for point in self._engine.getClosestPoints(a, b, 0.0):
                    if -float(point[8]) > worst[0]:
                        worst = (-float(point[8]), key_a, key_b)
        return worst


FELL_M = 0.05
"""What is so far below the top surface has left the table [m]."""
CLEAR_M = 0.01
"""Objects are let go with so much air around their boxes [m]."""
LOOK_S = 0.025
"""Whether objects rest or fall is looked at so often [s]."""
OUTWARD = 1e-6
"""Rounding of the outline that an object may cross [m]."""
SUNK_M = 0.001
"""A point so far below the top surface hangs over the rim, or is pressed into it [m]."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Resting:
    """What came to rest, and what did not."""

    Ts_table_obj: dict[int, Array]
    """Number of the object, in the order they were let go -> (4, 4) where it lies [m]."""
    fell: tuple[int, ...] = ()
    """Objects that left the table."""
    overhung: tuple[int, ...] = ()
    """Objects that came to rest over the rim, and were taken off."""
    restless: tuple[int, ...] = ()
    """Objects that did not come to rest in the time given, and were taken off."""
    moved_m: float = 0.0
    """Greatest way of any point in the last second settle [m]."""
    penetration_m: float = 0.0
    """Deepest of the final state [m]."""
    simulated_s: float = 0.0


def drop(
    table: TableModel,
    counts: tuple[int, int],
    next_solid: Callable[[int], SlipBody],
    config: DropConfig,
    rng: np.random.Generator,
) -> Resting:
    """Drop objects until they rest; where too few stay, more are dropped on them.

    Args:
        table: what they fall on.
        counts: how many are enough in the end, and how many are wanted on the table.
        next_solid: number of an object, from 0 -> its body; called once for each, in order.
        config: settings.
        rng: where and how each is let go.
    """
    enough, wanted = counts
    most = int(np.ceil(wanted * config.tries))
    solids: dict[int, SlipBody] = {}
    found = Resting(Ts_table_obj={})
    while not solids or (len(found.Ts_table_obj) < enough and len(solids) < most):
        fallen = _fall(table, found.Ts_table_obj, solids, (wanted, most), next_solid, config, rng)
        settled = _second_settles(table, solids, fallen.Ts_table_obj, config)
        found = _joined(found, fallen, settled)
    return found


def _joined(before: Resting, fallen: Resting, settled: Resting) -> Resting:
    """Return the state of the last with the losses of all three."""
    rests = (before, fallen, settled)
    return replace(
        settled,
        fell=tuple(k for r in rests for k in r.fell),
        overhung=tuple(k for r in rests for k in r.overhung),
        restless=tuple(k for r in rests for k in r.restless),
        simulated_s=sum(r.simulated_s for r in rests),
    )


def _fall(
    table: TableModel,
    there: dict[int, Array],
    solids: dict[int, SlipBody],
    counts: tuple[int, int],
    next_solid: Callable[[int], SlipBody],
    config: DropConfig,
    rng: np.random.Generator,
) -> Resting:
    """Let objects go on a table with others until it holds as many as wanted, or all were tried."""
    wanted, most = counts
    fell: list[int] = []
    with DropWorld(table, config) as world:
        for key, T in there.items():
            world.add(key, solids[key], T)
        seconds = 0.0
        while len(world.bodies) < wanted and len(solids) < most:
            for _ in range(min(config.wave, wanted - len(world.bodies), most - len(solids))):
                k = len(solids)
                solids[k] = next_solid(k)
                world.add(k, solids[k], _let_go(world, table, solids[k], config, rng))
            seconds += _pass(world, config.wave_s, fell)
        seconds += _until_rest(world, config.longest_s / 2, config, fell)
        world.resting()
        seconds += _until_rest(world, config.longest_s / 2, config, fell)
        restless = _moving(world, config)
        overhung = [
            k for k in world.bodies
            if k not in restless and not _on_table(world.points(k), table, config)
        ]  # fmt: skip
        for k in (*restless, *overhung):
            world.remove(k)
        return Resting(
            Ts_table_obj={k: world.pose(k) for k in world.bodies}, fell=tuple(fell),
            overhung=tuple(overhung), restless=tuple(restless), simulated_s=seconds,
        )  # fmt: skip


def _let_go(
    world: DropWorld,
    table: TableModel,
    solid: SlipBody,
    config: DropConfig,
    rng: np.random.Generator,
) -> Array:
    """Return T_table_obj (4, 4) from which an object falls: turned at random, clear of all others.

    Where something is below or beside it, it is let go higher.
    """
    R = se3.random_rotation(rng)
    low, high = table.inside.min(axis=0), table.inside.max(axis=0)
    reach = config.spread * float(np.min(high - low))
    angle, share = rng.uniform(0, 2 * np.pi), np.sqrt(rng.uniform())
    at = (low + high) / 2 + reach * share * np.array([np.cos(angle), np.sin(angle)])
    height = float(rng.uniform(*config.fall_m))
    points = np.concatenate(solid.parts) @ R.T
    a, b = points.min(axis=0), points.max(axis=0)
    # What is turned is the object's own frame; it is the middle of its box that is put there.
    shift = np.array([*(at - (a + b)[:2] / 2), height - a[2]])
    for key in world.bodies:
        other = world.points(key)
        c, d = other.min(axis=0) - CLEAR_M, other.max(axis=0) + CLEAR_M
        under = np.all(a[:2] + shift[:2] < d[:2]) and np.all(b[:2] + shift[:2] > c[:2])
        if under:
            shift[2] = max(shift[2], d[2] - a[2])
    return se3.from_rt(R, shift)


def _pass(world: DropWorld, seconds: float, fell: list[int]) -> float:
    """Let time pass and take away what leaves the table; return the time [s]."""
    spent = 0.0
    while spent < seconds:
        world.step(LOOK_S)
        spent += LOOK_S
        _clear(world, fell)
    return spent


def _clear(world: DropWorld, fell: list[int]) -> None:
    for key, height in world.heights().items():
        if not height > -FELL_M:  # NaN, too: the engine has lost it
            world.remove(key)
            fell.append(key)


def _until_rest(world: DropWorld, longest_s: float, config: DropConfig, fell: list[int]) -> float:
    """Let time pass until everything rests for a while; return the time [s]."""
    spent = quiet = 0.0
    while spent < longest_s and quiet < config.rest_s:
        world.step(LOOK_S)
        spent += LOOK_S
        _clear(world, fell)
        quiet = 0.0 if _moving(world, config) else quiet + LOOK_S
    return spent


def _moving(world: DropWorld, config: DropConfig) -> list[int]:
    return [
        key
        for key, (speed, turning) in world.speeds().items()
        if not (speed < config.rest_m_s and turning < config.rest_rad_s)
    ]


def _on_table(points: Array, table: TableModel, config: DropConfig) -> bool:
    """Return whether no point (V, 3) lies beyond the rim or below the top surface."""
    a = table.outline
    edge = np.roll(a, -1, axis=0) - a
    outward = np.stack([edge[:, 1], -edge[:, 0]], -1)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    away = points[:, :2] @ outward.T - np.einsum("ij,ij->i", outward, a)
    return bool(away.max() <= OUTWARD - config.edge_m and points[:, 2].min() >= -SUNK_M)


# --- the second settle ------------------------------------------------------------------------


def settle(
    table: TableModel, solids: dict[int, SlipBody], poses: dict[int, Array], config: DropConfig
) -> tuple[dict[int, Array], dict[int, float], float]:
    """Let a fresh world with the objects at their poses run for `check_s`.

    Returns:
        the poses after it, the greatest way of any point of each object [m] (inf = it left the
        table), and the deepest penetration before it [m].
    """
    with DropWorld(table, config) as world:
        world.resting()
        for key, T in poses.items():
            world.add(key, solids[key], T)
        depth = world.deepest()[0]
        before = {key: world.points(key) for key in poses}
        fell: list[int] = []
        ways = dict.fromkeys(poses, 0.0)
        for _ in range(4):
            _pass(world, config.check_s / 4, fell)
            for key in world.bodies:
                way = np.linalg.norm(world.points(key) - before[key], axis=1)
                ways[key] = max(ways[key], float(way.max()))
        ways |= dict.fromkeys(fell, float("inf"))
        return {key: world.pose(key) for key in world.bodies}, ways, depth


def _second_settles(
    table: TableModel, solids: dict[int, SlipBody], poses: dict[int, Array], config: DropConfig
) -> Resting:
    """Settle again until nothing moves; what does not stop moving is taken off."""
    fell: list[int] = []
    overhung: list[int] = []
    restless: list[int] = []
    turn, ways, depth = 0, dict[int, float](), 0.0
    while poses:
        after, ways, depth = settle(table, solids, poses, config)
        turn += 1
        if max(ways.values()) <= config.stays_m:
            break
        gone = [k for k in poses if k not in after]
        over = [k for k, T in after.items() if not _on_table(_at(solids[k], T), table, config)]
        fell, overhung = [*fell, *gone], [*overhung, *over]
        poses = {k: T for k, T in after.items() if k not in over}
        if turn >= config.rounds and not gone and not over:
            worst = max(poses, key=lambda k: ways[k])
            restless.append(worst)
            poses = {k: T for k, T in poses.items() if k != worst}
    return Resting(
        Ts_table_obj=poses, fell=tuple(fell), overhung=tuple(overhung), restless=tuple(restless),
        moved_m=max((ways[k] for k in poses), default=0.0), penetration_m=depth if poses else 0.0,
        simulated_s=turn * config.check_s,
    )  # fmt: skip


def _at(solid: SlipBody, T_table_obj: Array) -> Array:
    return se3.transform(T_table_obj, np.concatenate(solid.parts))
