"""All tried grasps of a scene, as files of grasps hold them: sets, attempts and where things stood.

What a set may hold is checked here, the same on writing and on reading: a file that was written can
be read, and a file that cannot have been written is refused.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.errors import InputError
from realsim.geometry import se3
from realsim.records import STAGES, GraspSet
from realsim.records.checked_arrays import rigid
from realsim.records.grasps import MEASURES, GraspTrajectories, require_one_hand
from realsim.untrusted.own_json import array_from_json, to_json


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SceneGrasps:
    """The grasp sets of one scene, with the attempts and poses that are known."""

    sets: tuple[GraspSet, ...]
    """One per object instance; kept in the order of the instances."""
    name: str = ""
    """Name of the scene."""
    names: Mapping[int, str] = field(default_factory=dict[int, str])
    """Names of the objects, by object id; of objects without a set none is kept."""
    trajectories: Mapping[int, GraspTrajectories] = field(
        default_factory=dict[int, GraspTrajectories]
    )
    """What the arm did, by instance."""
    Ts_world_obj: Mapping[int, Array] = field(default_factory=dict[int, Array])
    """(4, 4) object in world [m], by instance."""
    T_world_table: Array | None = None
    """(4, 4) table in world [m]."""

    def __post_init__(self) -> None:
        """Check that everything speaks of the sets that are there, and freeze it."""
        instances = [s.instance for s in self.sets]
        twice = sorted({i for i in instances if instances.count(i) > 1})
        if twice:
            raise InputError(f"instance {twice[0]} has more than one grasp set; one is expected.")
        for what in ("trajectories", "Ts_world_obj"):
            unknown = sorted(set(getattr(self, what)) - set(instances))
            if unknown:
                raise InputError(
                    f"{what} name instance {unknown[0]}, which has no grasp set; there are: "
                    f"{', '.join(map(str, instances)) or 'none'}."
                )
        require_one_hand(self.sets, f"the scene '{self.name}'" if self.name else "a scene")
        object.__setattr__(self, "sets", tuple(sorted(self.sets, key=lambda s: s.instance)))
        ids = {s.obj_id for s in self.sets}
        names = {i: self.names[i] for i in sorted(ids & set(self.names)) if self.names[i]}
        object.__setattr__(self, "names", names)
        for s in self.sets:
            check_values(s)
            if s.instance in self.trajectories:
                check_attempts(s, self.trajectories[s.instance])
        poses = {i: rigid(T, f"T_world_obj of instance {i}") for i, T in self.Ts_world_obj.items()}
        object.__setattr__(self, "Ts_world_obj", poses)
        if self.T_world_table is not None:
            object.__setattr__(self, "T_world_table", rigid(self.T_world_table, "T_world_table"))

    def Ts_world_grasp(self, grasps: GraspSet) -> Array | None:
        """Return the grasps (N, 4, 4) in world [m], None where the object's pose is not known."""
        T_world_obj = self.Ts_world_obj.get(grasps.instance)
        return None if T_world_obj is None else T_world_obj @ grasps.Ts_obj_grasp

    def Ts_table_grasp(self, grasps: GraspSet) -> Array | None:
        """Return the grasps (N, 4, 4) in the table's frame [m], None where it is not known."""
        Ts_world_grasp = self.Ts_world_grasp(grasps)
        if Ts_world_grasp is None or self.T_world_table is None:
            return None
        return se3.invert(self.T_world_table) @ Ts_world_grasp


def check_values(grasps: GraspSet) -> None:
    """Check that every number of a set means something.

    Raises:
        InputError: a width is negative or infinite, a score or share outside 0 to 1, a base score
            no quarter, a slip negative, a reason that no file can hold, or parameters that are not
            plain JSON values.
    """
    who = f"the grasp set of instance {grasps.instance}"
    quarters = np.arange(len(STAGES) + 1) / len(STAGES)
    _require(grasps.widths_m, _within(grasps.widths_m, 0.0, 1e3), who, "a width", "0 or more [m]")
    _require(grasps.scores, _within(grasps.scores, 0.0, 1.0), who, "a score", "0 to 1")
    is_quarter = np.isin(grasps.base_scores, quarters)
    _require(grasps.base_scores, is_quarter, who, "a base score", "0, 0.25, 0.5, 0.75 or 1")
    for name in ("slip_m", "slip_rad"):
        values: Array = getattr(grasps, name)
        _require(values, values >= 0, who, f"a value of {name}", "0 or more, inf = lost")
    for name, values in grasps.measures.items():
        if MEASURES[name].is_share:
            _require(values, _within(values, 0.0, 1.0), who, f"a {name}", "0 to 1")
    for text in grasps.failures:
        if "\0" in text or not _is_text(text):
            raise InputError(f"{who} has a reason that is no plain text: {text[:40]!r}.")
    parameters_json(grasps)


def check_attempts(grasps: GraspSet, attempts: GraspTrajectories) -> None:
    """Check that attempts belong to a set and that their time goes forward.

    Raises:
        InputError: they do not, or it does not.
    """
    who = f"the trajectories of instance {grasps.instance}"
    rows = attempts.rows
    if len(rows) and (rows[0] < 0 or rows[-1] >= len(grasps) or np.any(np.diff(rows) <= 0)):
        raise InputError(
            f"{who} belong to rows {rows.min()} to {rows.max()}; increasing rows of a set of "
            f"{len(grasps)} grasps are expected."
        )
    inside = np.ones(len(attempts.time_s), dtype=np.bool_)
    inside[attempts.starts[:-1][attempts.starts[:-1] < len(inside)]] = False
    steps = np.diff(attempts.time_s, prepend=0.0)
    if np.any(steps[inside] < 0) or not np.all(np.isfinite(attempts.time_s)):
        raise InputError(f"{who} go back in time; each attempt's times must not decrease.")
    if not (np.all(np.isfinite(attempts.joints_rad)) and np.all(np.isfinite(attempts.opening_m))):
        raise InputError(f"{who} hold joint angles or openings that are not finite numbers.")


def parameters_json(grasps: GraspSet) -> str:
    """Return a set's parameters as JSON.

    Raises:
        InputError: they hold something that JSON does not give back as it is.
    """
    try:
        text = json.dumps(grasps.parameters, allow_nan=False)
        same = json.loads(text) == grasps.parameters
    except (TypeError, ValueError) as error:
        raise InputError(
            f"the parameters of instance {grasps.instance} are not plain JSON values ({error})."
        ) from error
    if not same:
        raise InputError(
            f"the parameters of instance {grasps.instance} hold what JSON does not give back as it "
            "is (a tuple, a number as a key); give lists and texts."
        )
    return text


def measures_json(grasps: GraspSet, rows: Int64) -> dict[str, Any]:
    """Return what was measured of some rows as plain JSON values, by name."""
    return {name: to_json(values[rows]) for name, values in grasps.measures.items()}


def measures_of_json(told: Any, n: int, where: str) -> dict[str, Array]:
    """Return the measures of n grasps that `measures_json` made JSON of.

    Raises:
        InputError: they are no measures, or of another number of grasps.
    """
    try:
        unknown = sorted(set(told) - set(MEASURES))
        found = {
            name: array_from_json(told[name], (n, len(STAGES)) if kind.by_stage else (n,))
            for name, kind in MEASURES.items()
            if name in told
        }
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: the measures are not those of {n} grasps ({error}).") from error
    if unknown:
        raise InputError(
            f"{where}: '{unknown[0]}' is no measure of a grasp; there are: {', '.join(MEASURES)}."
        )
    return found


def stored_values(grasps: GraspSet, name: str, other: Array) -> Array:
    """Return a number a grasp out of a set's parameters, else the other (N,)."""
    stored = grasps.parameters.get(name)
    if isinstance(stored, list) and np.shape(stored) == (len(grasps),):  # pyright: ignore[reportUnknownArgumentType]
        return np.array(stored, dtype=np.float64)
    return other


def executed(grasps: GraspSet) -> Mask:
    """Return (N,) which grasps physics has tried: the first stage was executed."""
    return ~np.isnan(grasps.slip_m[:, 0])


def labelled(grasps: GraspSet) -> Mask:
    """Return (N,) which grasps have a label of their own: tried by physics, or with a p_hold."""
    known = ~np.isnan(grasps.measures.get("p_hold", np.full(len(grasps), np.nan)))
    return (executed(grasps) | known) & ~np.isnan(grasps.labels)


def held(grasps: GraspSet) -> Mask:
    """Return (N,) which grasps still held the object after all four stages, however it slipped."""
    return np.all(np.isfinite(grasps.slip_m) & np.isfinite(grasps.slip_rad), axis=1)


def untried_set(
    Ts_obj_grasp: Array, *, obj_id: int, instance: int = 0, widths_m: Array | None = None,
    parameters: dict[str, Any] | None = None, measures: dict[str, Array] | None = None,
) -> GraspSet:  # fmt: skip
    """Return grasps that came from elsewhere as a set that physics has not tried.

    Args:
        Ts_obj_grasp: (N, 4, 4) [m].
        obj_id: of the object.
        instance: of the object.
        widths_m: (N,) [m]; None = not known.
        parameters: where they came from, as plain JSON values.
        measures: what the file says of them, by the names of MEASURES.
    """
    n = len(Ts_obj_grasp)
    nothing = np.full((n, len(STAGES)), np.nan)
    return GraspSet(
        obj_id=obj_id,
        instance=instance,
        Ts_obj_grasp=Ts_obj_grasp,
        widths_m=np.full(n, np.nan) if widths_m is None else widths_m,
        scores=nothing[:, 0],
        base_scores=nothing[:, 0],
        slip_m=nothing,
        slip_rad=nothing,
        reachable=np.zeros(n, dtype=np.bool_),
        failures=("not tried",) * n,
        measures=measures or {},
        parameters=parameters or {},
    )


def _within(values: Array, low: float, high: float) -> Mask:
    return (values >= low) & (values <= high)


def _require(values: Array, right: Mask, who: str, what: str, wanted: str) -> None:
    """Check that every value is right or NaN."""
    wrong = ~right & ~np.isnan(values)
    if np.any(wrong):
        at = np.argwhere(wrong)[0]
        raise InputError(
            f"{who} has {what} of {values[tuple(at)]:g} at grasp {at[0]}; {wanted}, or NaN for "
            "not known, is accepted."
        )


def _is_text(text: str) -> bool:
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True
