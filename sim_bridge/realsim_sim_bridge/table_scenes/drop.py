"""Objects dropped on a table until they rest, and the proof that they do.

Objects are let go in waves, so that they land on each other. Then the engine takes the Robot
School's settings, and from the poses found there a second settle in a fresh world must move no
point by more than `stays_m`; until it does, its end is where the next begins.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from realsim.arrays import Array
from realsim.geometry import se3
from realsim_sim_bridge.slip.world import SlipBody
from realsim_sim_bridge.table_scenes.config import DropConfig
from realsim_sim_bridge.table_scenes.drop_world import DropWorld
from realsim_sim_bridge.table_scenes.tables import TableModel

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
