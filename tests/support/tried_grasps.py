"""Grasp sets and attempts with every kind of value that they may have."""

import numpy as np

from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.geometry import se3
from realsim.records import STAGES, GraspSet
from realsim.records.grasps import MEASURES, PHASES, GraspTrajectories

REASONS = ("", "lost in lift", "kein Weg: Arm stößt an", "slip of 3 cm, 'oscillate'", "日本")


def tried_set(rng, n=20, *, obj_id=7, instance=2, measures=tuple(MEASURES)):
    """Return a set: a sixth was not tried, a sixth has no path, the rest stopped anywhere."""
    kind = rng.integers(0, 6, n)
    last = np.where(kind < 2, -1, rng.integers(0, 5, n))
    stage = np.arange(len(STAGES))
    slip = rng.uniform(0, 0.02, (n, 4))
    slip[stage > last[:, None]] = np.nan
    slip[(stage == last[:, None]) & (rng.random(n) < 0.5)[:, None]] = np.inf
    base = np.where(kind == 0, np.nan, np.clip(last, 0, 4) / 4)
    values = {}
    for name in measures:
        known = [np.nan, 0.25, -0.0, 1 / 3] + [np.inf] * (not MEASURES[name].is_share)
        values[name] = rng.choice(known, (n, 4) if MEASURES[name].by_stage else (n,))
    return GraspSet(
        obj_id=obj_id, instance=instance,
        Ts_obj_grasp=se3.random_transform(rng, n, 0.1) if n else np.zeros((0, 4, 4)),
        widths_m=rng.uniform(0, 0.08, n),
        scores=np.where(kind == 0, np.nan, np.clip(base - rng.integers(0, 3, n) / 12, 0, 1)),
        base_scores=base, slip_m=slip, slip_rad=slip * 3, reachable=kind > 1,
        failures=tuple(REASONS[k] for k in rng.integers(0, len(REASONS), n)), measures=values,
        parameters={"config": {"friction": 0.5, "names": ["a", "ö"]}, "seed": 4, "none": None},
    )  # fmt: skip


def plain_grasps(Ts_obj_grasp, **known):
    """Return grasps, or this many at the object's origin, of which only `known` is known.

    They are 5 cm wide, of object 1's instance 0, reachable, and nobody has tried them.
    """
    if isinstance(Ts_obj_grasp, int):
        Ts_obj_grasp = np.tile(np.eye(4), (Ts_obj_grasp, 1, 1))
    n = len(Ts_obj_grasp)
    unknown = np.full((n, 4), np.nan)
    plain = {
        "obj_id": 1, "instance": 0, "Ts_obj_grasp": Ts_obj_grasp, "widths_m": np.full(n, 0.05),
        "scores": unknown[:, 0], "base_scores": unknown[:, 0], "slip_m": unknown,
        "slip_rad": unknown, "reachable": np.ones(n, bool), "failures": ("",) * n,
    }  # fmt: skip
    return GraspSet(**(plain | known))


def attempts_of(rng, grasps, joints=7):
    """Return attempts at about half of the grasps; one of them has no sample."""
    rows = np.flatnonzero(rng.random(len(grasps)) < 0.5)
    rows = rows if len(rows) else np.arange(min(1, len(grasps)))
    counts = rng.integers(1, 12, len(rows))
    if len(counts) > 1:
        counts[0] = 0
    starts = np.concatenate([[0], np.cumsum(counts)])
    times = [np.sort(rng.random(c)) for c in counts]
    total = int(starts[-1])
    return GraspTrajectories(
        rows=rows, starts=starts, time_s=np.concatenate(times),
        joints_rad=rng.normal(size=(total, joints)), opening_m=rng.uniform(0, 0.08, total),
        phase=rng.integers(0, len(PHASES), total),
    )  # fmt: skip


def tried_scene(seed, *, with_poses=True, with_attempts=True):
    """Return a scene: sets with all, some and no measures, and one without a grasp."""
    rng = np.random.default_rng(seed)
    sets = (
        tried_set(rng, int(rng.integers(2, 40)), obj_id=9, instance=4),
        tried_set(rng, int(rng.integers(2, 40)), obj_id=9, instance=0, measures=("margin",)),
        tried_set(rng, 0, obj_id=3, instance=1, measures=("force_n",)),
        tried_set(rng, int(rng.integers(2, 40)), obj_id=12, instance=7, measures=()),
    )
    poses = {s.instance: se3.random_transform(rng) for s in sets[:3]} if with_poses else {}
    tried = {s.instance: attempts_of(rng, s) for s in (sets[0], sets[3])} if with_attempts else {}
    return SceneGrasps(
        sets=sets, name="Tisch 1", names={9: "mug", 12: "box"}, trajectories=tried,
        Ts_world_obj=poses, T_world_table=se3.random_transform(rng) if with_poses else None,
    )  # fmt: skip


def assert_same(a, b, atol=0.0):
    """Every field is equal, arrays bit for bit or, where `atol` is given, to within it.

    Where the arrays of the first cannot be changed, those of the second cannot either.
    """
    assert type(a) is type(b)
    for name in a.__dataclass_fields__:
        same_value(getattr(a, name), getattr(b, name), name, atol)


def same_value(x, y, name, atol):
    """Two values are equal, arrays bit for bit or to within `atol`."""
    if hasattr(x, "__dataclass_fields__"):
        assert_same(x, y, atol)
    elif isinstance(x, np.ndarray):
        assert isinstance(y, np.ndarray) and x.dtype == y.dtype and x.shape == y.shape, name
        close = atol and np.allclose(x, y, rtol=0, atol=atol, equal_nan=True)
        assert close or x.tobytes() == y.tobytes(), name
        assert x.flags.writeable or not y.flags.writeable, name
    elif isinstance(x, dict):
        assert isinstance(y, dict) and sorted(x) == sorted(y), name
        for key in x:
            same_value(x[key], y[key], f"{name}[{key}]", atol)
    elif isinstance(x, tuple):
        assert isinstance(y, tuple) and len(x) == len(y), name
        for k, (p, q) in enumerate(zip(x, y, strict=True)):
            same_value(p, q, f"{name}[{k}]", atol)
    elif isinstance(x, float):
        assert x.hex() == y.hex(), name  # NaN is not equal to itself
    else:
        assert repr(x) == repr(y), name
