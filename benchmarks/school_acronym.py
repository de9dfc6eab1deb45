"""ACRONYM's labels of a mug against ours: reported, not aimed at.

ACRONYM's simulator lets objects creep out of the fingers, which Coulomb's law does not: a
simulation that agrees with it more is not a better one
(docs/decisions/0018-what-the-labels-mean.md). The data is found through REALSIM_DATA.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from figures import Found
from school_cases import in_processes, slip_config

from realsim.arrays import Mask

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))

from grasp_files import read_acronym
from realsim.geometry import se3
from realsim.geometry.mesh import mass_properties
from realsim.models.convex import ConvexConfig, convex_parts
from realsim.models.properties import physical_properties
from realsim.records import Mesh
from realsim.robots.hand import find_hand
from realsim_sim_bridge.slip.slip_test import SlipTrial, run_slip_test
from realsim_sim_bridge.slip.world import SlipBody
from realsim_sim_bridge.validation.labels import PATIENT
from realsim_sim_bridge.validation.specimens import ready_trial

ENGINES = ("pybullet", "mujoco")
DENSITY = 150.0
"""ACRONYM's [kg/m^3]."""
CONVEX = ConvexConfig(thresholds=(0.05,), max_parts=32)
EACH, EACH_QUICK = 48, 5
"""Grasps of either label."""
RESAMPLES = 2000


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Half:
    """Some of the grasps, for one engine."""

    engine: str
    trial: SlipTrial


def held_by(half: _Half) -> Mask:
    """Return which grasps hold the mug to the end (N,)."""
    config = slip_config(half.engine, "plain", half.trial.body.mass_kg)
    return run_slip_test(half.trial, config, PATIENT).passed


def acronym(seed: int, keep: Path, quick: bool) -> Found:
    """Return the balanced accuracy of our held labels against ACRONYM's."""
    found = Found()
    folder = found.real_data("acronym", "school/acronym_mug")
    if folder is None:
        return found
    Ts_obj_grasp, label, scale = read_acronym(next(folder.glob("Mug_*.h5")))
    rng = np.random.default_rng([seed, 4])
    each = EACH_QUICK if quick else EACH
    rows = np.concatenate(
        [rng.permutation(np.flatnonzero(label == value))[:each] for value in (True, False)]
    )
    body, words = _body(folder, scale, keep)
    Ts = Ts_obj_grasp[rows]
    # The mug stands as its mesh was drawn; what the table frame's place is does not matter.
    standing = se3.from_rt(Ts[:, :3, :3], np.zeros(3))
    trial = ready_trial(body, Ts, standing, find_hand().max_opening_m)
    halves = [
        _Half(engine=engine, trial=trial.part(slice(k, None, 2)))
        for engine in ENGINES
        for k in range(2)
    ]
    held = in_processes(held_by, halves)
    truth = label[rows]
    for n, engine in enumerate(ENGINES):
        ours = np.zeros(len(rows), dtype=np.bool_)
        ours[0::2], ours[1::2] = held[2 * n], held[2 * n + 1]
        value = balanced_accuracy(truth, ours)
        drawn = [
            balanced_accuracy(truth[pick], ours[pick])
            for pick in rng.integers(0, len(rows), (RESAMPLES, len(rows)))
        ]
        low, high = np.nanpercentile(drawn, (2.5, 97.5))
        said = (
            f"[{low:.2f}, {high:.2f}] of {len(rows)} grasps; we hold "
            f"{int(np.sum(ours & truth))} of {int(truth.sum())} that ACRONYM holds and "
            f"{int(np.sum(ours & ~truth))} of {int(np.sum(~truth))} that it drops"
        )
        if n == 0:
            found.add("acronym_balacc", value, f"{engine}, {said}")
        else:
            found.add(f"acronym_balacc_{engine}", value, said)
    found.notes.append(f"acronym: {words}")
    return found


def balanced_accuracy(truth: Mask, ours: Mask) -> float:
    """Return the mean share of held and of dropped ones told right; NaN without either."""
    if truth.all() or not truth.any():
        return float("nan")
    return 0.5 * float(np.mean(ours[truth]) + np.mean(~ours[~truth]))


def _body(folder: Path, scale: float, keep: Path) -> tuple[SlipBody, str]:
    """Return the mug for the engines, and in words what it is."""
    import trimesh

    # In units of its own, which only the scale makes metres.
    drawn: Any = trimesh.load(next(folder.glob("*.obj")), force="mesh", process=False)
    mesh = Mesh(vertices=scale * np.asarray(drawn.vertices), faces=np.asarray(drawn.faces))
    parts = convex_parts(mesh, CONVEX, keep / "convex")
    matter = physical_properties(mesh, density=DENSITY, parts=parts)
    closed = mass_properties(mesh, DENSITY).is_watertight
    return SlipBody.of(parts, matter), (
        f"a mug of {1e3 * matter.mass_kg:.0f} g, {'closed' if closed else 'not closed'}, in "
        f"{len(parts.parts)} convex parts of {parts.volume_ratio:.2f} times its volume"
    )
