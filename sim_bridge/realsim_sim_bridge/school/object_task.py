"""The first job of an object in the school: its candidates, and which of them the arm takes."""

import hashlib
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array, Int64, Mask
from realsim.errors import InputError
from realsim.formats.graspnet.grasp_labels import read_grasp_labels
from realsim.geometry.mesh import MassProperties, mass_properties
from realsim.models.convex import convex_parts
from realsim.models.model_records import KnownSolid
from realsim.records import Mesh
from realsim.records.grasps import GraspTrajectories
from realsim_sim_bridge.arm.reach import Reach, ReachTask, check_reach
from realsim_sim_bridge.arm.reach_config import grasping_arm
from realsim_sim_bridge.grasping.analytic import AnalyticConfig, analytic_labels, select_rows
from realsim_sim_bridge.grasping.analytic_given import given_candidates, standing_labels
from realsim_sim_bridge.grasping.candidates import Candidates, sample_candidates
from realsim_sim_bridge.grasping.force_closure import ClosureConfig, force_closure
from realsim_sim_bridge.grasping.surroundings import Surroundings, standing_object
from realsim_sim_bridge.hold.draws import chance_columns
from realsim_sim_bridge.school.config import SchoolConfig
from realsim_sim_bridge.slip.slip_test import SlipTrial
from realsim_sim_bridge.slip.stand import Stand
from realsim_sim_bridge.slip.world import SlipBody

# --- Analytic grasps as what the School tries: labels of an object, those that stand, a few of them
# GraspNet's labels say from which friction on a grasp closes. The School says what becomes of it.


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class AnalyticGrasps:
    """Labels of one object that the School tries where it stands."""

    candidates: Candidates
    closure_friction: Array
    """(N,) of the label: the smallest of its friction levels that closes."""
    counts: dict[str, Any]
    """How many labels there were after each step, where they came from, and which label each
    grasp is (point, view, angle, depth)."""


def analytic_grasps(
    task: "ObjectTask", config: AnalyticConfig, rng: np.random.Generator
) -> AnalyticGrasps:
    """Return labels of an object, spread over it and over the friction levels, that stand free.

    They are read where the task names a file, else computed.

    Raises:
        InputError: the file is not one of labels, or the mesh has no area.
    """
    config = replace(config, max_opening_m=task.config.hand.max_opening_m)
    most = max(config.levels)
    if task.labels_file is not None:
        labels = read_grasp_labels(task.labels_file, friction_at_most=most)
    else:
        labels = analytic_labels(task.mesh, rng, config)
    school = task.config
    where = (task.mesh, task.T_table_obj, task.neighbours)
    standing = standing_labels(labels, *where, school.candidates, school.hand, rng)
    chosen = standing.rows(select_rows(standing, school.max_candidates, rng))
    found, rows = given_candidates(*where, chosen.Ts_obj_grasp(), school.candidates, school.hand)
    return AnalyticGrasps(
        candidates=found,
        # Files of labels keep single precision: 0.4 comes back as 0.4.
        closure_friction=np.round(chosen.friction.astype(np.float64), 6)[rows],
        counts={
            "from": "computed" if task.labels_file is None else task.labels_file.name,
            "labels": len(labels.friction),
            "labels_standing": len(standing.friction),
            "labels_chosen": len(chosen.friction),
            "label_index": chosen.index[rows].tolist(),
        },
    )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ObjectTask:
    """One object where it stands."""

    obj_id: int
    instance: int
    name: str
    mesh: Mesh
    """Without colours [m]."""
    density: float
    """[kg/m^3]."""
    T_table_obj: Array
    """(4, 4) [m]."""
    neighbours: Surroundings
    """The surfaces of all other objects, table frame."""
    names: tuple[tuple[int, str], ...]
    """Instance and name of every object of the scene: reasons speak of neighbours by name."""
    middle_xy: tuple[float, float]
    """Middle of the scene on the table [m]."""
    config: SchoolConfig
    cache: Path | None
    """Folder for the convex parts of meshes, or None to keep none."""
    solid: KnownSolid | None = None
    """Convex parts and matter, where a model library knows them."""
    covariance: Array | None = None
    """(6, 6) of the registered pose, right perturbation, rotation first [rad, m], if known."""
    labels_file: Path | None = None
    """GraspNet's labels of the object, where the config asks for analytic grasps; None = they are
    computed."""

    def inputs(self) -> dict[str, Any]:
        """Return everything the result depends on besides the config; arrays as hashes."""
        known: dict[str, Any] = {}
        if self.solid is not None:
            matter = self.solid.matter
            known = {
                "known_mass_kg": float(matter.mass_kg),
                "known_center_of_mass_m": np.asarray(matter.center_of_mass).tolist(),
                "known_inertia": _hash(matter.inertia),
                "known_parts": _hash(*self.solid.parts.parts),
            }
        if self.covariance is not None:
            known["covariance"] = _hash(self.covariance)
        if self.labels_file is not None:
            digest = hashlib.sha256(self.labels_file.read_bytes()).hexdigest()
            known["labels"] = f"{self.labels_file.name} {digest[:16]}"
        return {
            "obj_id": self.obj_id,
            "name": self.name,
            "mesh": _hash(self.mesh.vertices, self.mesh.faces),
            "density": self.density,
            "T_table_obj": self.T_table_obj.tolist(),
            "middle_xy_m": list(self.middle_xy),
            "neighbours": _hash(
                self.neighbours.points,
                self.neighbours.instances,
                self.neighbours.triangles,
                self.neighbours.triangle_instances,
            ),
            **known,
        }


def _hash(*arrays: NDArray[Any]) -> str:
    """Return a short hash of arrays."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(str(array.shape).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Prepared:
    """An object's candidates, which of them the arm takes, and its body for the engine."""

    Ts_obj_grasp: Array
    """(N, 4, 4) [m]."""
    widths_m: Array
    openings_m: Array
    """(N,) [m]."""
    reachable: Mask
    joints: Array
    """(N, n) at the grasp [rad]; NaN where not reachable."""
    joints_lifted: Array
    """(N, n) after the lift [rad]; NaN likewise."""
    reasons: tuple[str, ...]
    """(N,) why not reachable."""
    trajectories: GraspTrajectories | None
    """Trajectories of the candidates that the arm takes; None = there is none."""
    measures: dict[str, Array]
    """What geometry alone says of the candidates, (N,) each."""
    body: SlipBody | None
    """None = the object is not tried."""
    notes: dict[str, Any]
    """What the set's parameters say about the object."""

    @property
    def tested(self) -> Int64:
        """The rows that go into the slip test."""
        if self.body is None:
            return np.zeros(0, dtype=np.int64)
        return np.nonzero(self.reachable)[0].astype(np.int64)


def prepare(task: ObjectTask, labels_file: Path | None = None) -> Prepared:
    """Return the object's candidates and which of them the arm takes.

    An object that cannot be tried (no volume, mass out of range) has no body; the notes say why.

    Args:
        task: the object.
        labels_file: where its labels are, if they are not where the task says.
    """
    if labels_file is not None:
        task = replace(task, labels_file=labels_file)
    config, rng = task.config, chance_of(task)
    analytic = None if config.analytic is None else analytic_grasps(task, config.analytic, rng)
    found = candidates_of(task, rng) if analytic is None else analytic.candidates
    notes: dict[str, Any] = {"counts": found.counts}
    if analytic is not None:
        notes["analytic"] = analytic.counts
    body, why_not = _body(task, notes)
    if body is None:
        return untried(task, why_not, found, notes)
    reach = reach_of(task, found, rng)
    notes["counts"] |= {"reachable": int(reach.reachable.sum()), "by_a_planned_path": reach.planned}
    notes["arm"] = {"stage_possible": reach.stage_possible.tolist(), "notes": list(reach.notes)}
    closure = force_closure(
        task.mesh,
        found.Ts_obj_grasp,
        found.openings_m,
        # At the friction of the slip test, or the two could not be compared.
        ClosureConfig(friction=config.slip.physics.friction),
        config.hand,
        body.center_of_mass,
        contact_depths_m=found.contact_depths_m,
    )
    prepared = Prepared(
        Ts_obj_grasp=found.Ts_obj_grasp,
        widths_m=found.widths_m,
        openings_m=found.openings_m,
        reachable=reach.reachable,
        joints=reach.joints,
        joints_lifted=reach.joints_lifted,
        reasons=tuple(_with_names(reason, dict(task.names)) for reason in reach.reasons),
        trajectories=reach.trajectories,
        # A label's own friction goes before that of graspnetAPI's evaluation, which is coarser.
        measures=closure.measures()
        | ({} if analytic is None else {"closure_friction": analytic.closure_friction}),
        body=body,
        notes=notes,
    )
    return replace(prepared, measures=prepared.measures | _chances(task, prepared))


def trial_of(
    task: ObjectTask, prepared: Prepared, rows: Int64, stand: Stand | None = None
) -> SlipTrial:
    """Return some rows of the candidates, ready for the slip test.

    Args:
        task: the object.
        prepared: its candidates.
        rows: some of them.
        stand: what it stands on while the fingers close; None = it is free.
    """
    assert prepared.body is not None, "rows are tested only of objects with a body"
    lifted = prepared.joints_lifted[rows]
    arm = grasping_arm(task.config.reach, task.config.hand)
    axes, points, ranges = arm.swing_in_grasp(lifted)
    Ts = prepared.Ts_obj_grasp[rows]
    return SlipTrial(
        body=prepared.body,
        Ts_obj_grasp=Ts,
        Ts_table_grasp=task.T_table_obj @ Ts,
        openings_m=prepared.openings_m[rows],
        swing_axes=axes,
        swing_points=points,
        swing_ranges=ranges,
        stand=stand,
    )


def _chances(task: ObjectTask, prepared: Prepared) -> dict[str, Array]:
    """Return the draws' outcomes as columns of all candidates; NaN where not tested."""
    config, rows = task.config, prepared.tested
    if config.hold is None or len(rows) == 0:
        return {}
    found = chance_columns(
        task.mesh, trial_of(task, prepared, rows), config.slip, config.hand, config.hold,
        task.covariance,
    )  # fmt: skip
    columns: dict[str, Array] = {}
    for name, values in found.items():
        columns[name] = np.full((len(prepared.widths_m), *values.shape[1:]), np.nan)
        columns[name][rows] = values
    return columns


def chance_of(task: ObjectTask) -> np.random.Generator:
    """Return the object's own source of chance, whatever the others do."""
    return np.random.default_rng([task.config.seed, task.instance])


def candidates_of(task: ObjectTask, rng: np.random.Generator) -> Candidates:
    """Return the object's candidates where it stands."""
    config = task.config
    return sample_candidates(
        task.mesh,
        task.T_table_obj,
        task.neighbours,
        config.candidates,
        config.hand,
        rng,
        config.max_candidates,
    )


def reach_of(task: ObjectTask, found: Candidates, rng: np.random.Generator) -> Reach:
    """Return which candidates the arm takes, and how it moves."""
    config = task.config
    obj = standing_object(
        task.mesh, task.T_table_obj, task.instance, config.candidates.object_points
    )
    reach = ReachTask(
        Ts_table_grasp=task.T_table_obj @ found.Ts_obj_grasp,
        widths_m=found.widths_m,
        openings_m=found.openings_m,
        obj=obj,
        neighbours=task.neighbours,
        middle_xy=task.middle_xy,
    )
    arm = grasping_arm(config.reach, config.hand)
    return check_reach(reach, config.reach, arm, rng, config.slip.motion)


def untried(
    task: ObjectTask,
    why_not: str,
    found: Candidates | None = None,
    notes: dict[str, Any] | None = None,
) -> Prepared:
    """Return the candidates of an object that cannot be tried; None = not even they were found."""
    n = 0 if found is None else len(found.widths_m)
    nowhere = np.full((n, task.config.reach.arm.found().joints), np.nan)
    return Prepared(
        Ts_obj_grasp=np.zeros((0, 4, 4)) if found is None else found.Ts_obj_grasp,
        widths_m=np.zeros(0) if found is None else found.widths_m,
        openings_m=np.zeros(0) if found is None else found.openings_m,
        reachable=np.zeros(n, dtype=np.bool_),
        joints=nowhere,
        joints_lifted=nowhere,
        reasons=(f"not tried: {why_not}",) * n,
        trajectories=None,
        measures={},
        body=None,
        notes={**(notes or {}), "not_tried": why_not},
    )


def _with_names(reason: str, names: dict[int, str]) -> str:
    """Return a reason with names in place of instance numbers."""

    def named(found: re.Match[str]) -> str:
        instance = int(found[1])
        return f"'{names[instance]}' (instance {instance})" if instance in names else found[0]

    return re.sub(r"the object of instance (\d+)", named, reason)


def _body(task: ObjectTask, notes: dict[str, Any]) -> tuple[SlipBody | None, str]:
    """Return the object for the engine, or None and why it is not tried."""
    config, known = task.config, task.solid
    try:
        mass = known.matter if known else mass_properties(task.mesh, task.density)
    except InputError as error:
        return None, str(error)
    notes |= {
        "mass_kg": mass.mass_kg,
        "center_of_mass_m": mass.center_of_mass.tolist(),
        "watertight": (
            mass.is_watertight if isinstance(mass, MassProperties) else mass.volume_of == "mesh"
        ),
    }
    if not config.least_mass_kg <= mass.mass_kg <= config.greatest_mass_kg:
        return None, (
            f"the object '{task.name}' weighs {mass.mass_kg:.4g} kg at {task.density:g} kg/m^3; "
            f"between {config.least_mass_kg:g} and {config.greatest_mass_kg:g} kg is accepted. "
            "Is its mesh in metres?"
        )
    if notes["counts"]["kept"] == 0:
        return None, "no candidate is left; the counts say what each filter took"
    try:
        convex = known.parts if known else convex_parts(task.mesh, config.convex, task.cache)
    except InputError as error:
        return None, str(error)
    notes["convex"] = {
        "parts": len(convex.parts),
        "volume_ratio": convex.volume_ratio,
        "method": convex.method,
        "from": "library" if known else "mesh",
    }
    return SlipBody.of(convex, mass), ""
