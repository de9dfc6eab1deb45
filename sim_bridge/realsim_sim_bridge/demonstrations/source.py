"""The attempts of a school as demonstrations: lazy, in order, one in memory at a time.

    source = DemonstrationSource(grasps, models)
    for step in source.stream(0):
        rgb = step.look("front")

A replayed attempt is some kilobytes; its pictures are made one by one, and kept by nobody.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import overload

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.geometry import se3
from realsim.geometry.mesh import hull_vertices
from realsim.models.model_records import KnownSolid
from realsim.records import ObjectModel
from realsim.records.grasps import LABEL_MEASURES
from realsim.untrusted.own_json import to_json
from realsim_sim_bridge.arm.grasping_arm import GraspingArm
from realsim_sim_bridge.arm.reach_config import base_on_table, grasping_arm
from realsim_sim_bridge.demonstrations import records
from realsim_sim_bridge.demonstrations.attempt_motion import Attempt, AttemptMotion, attempt_motion
from realsim_sim_bridge.demonstrations.front_view import (
    FrontView,
    happening,
    placed_front,
    wrist_camera,
)
from realsim_sim_bridge.demonstrations.pictures import AttemptPictures, ScenePictures, drawn_mesh
from realsim_sim_bridge.demonstrations.school_settings import school_config_of, tried_body
from realsim_sim_bridge.demonstrations.slip_replay import RecordedEngine, replay_grasp
from realsim_sim_bridge.school.shards import stand_of
from realsim_sim_bridge.slip.engines import make_engine
from realsim_sim_bridge.slip.stand import Stand
from realsim_sim_bridge.slip.world import SlipBody

STAGES_IN_ALL = 4


@dataclass(frozen=True, kw_only=True, slots=True)
class AttemptName:
    """Which attempt: object instance and row of its grasp set."""

    instance: int
    grasp: int


@dataclass(frozen=True, kw_only=True, slots=True)
class NotAttempted:
    """A grasp that there is no attempt of."""

    instance: int
    grasp: int
    why: str


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Scenery:
    """What all demonstrations of a scene share."""

    cameras: Mapping[str, records.DemonstrationCamera]
    models: Mapping[int, ObjectModel]
    """By instance."""
    Ts_table_obj: Mapping[int, Array]
    """(4, 4) where everything stands at first [m], by instance."""
    T_table_base: Array
    arm: GraspingArm
    """The arm that attempts, with its hand."""
    pictures: ScenePictures


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Demonstration:
    """One attempt, replayed; its pictures are rendered when they are asked for."""

    name: AttemptName
    goal: records.GraspGoal
    outcome: records.AttemptOutcome
    motion: AttemptMotion
    scenery: Scenery
    pictures: AttemptPictures = field(init=False)

    def __post_init__(self) -> None:
        """Prepare for pictures; none is rendered yet."""
        pictures = AttemptPictures(self.scenery.pictures, self.name.instance, self.motion)
        object.__setattr__(self, "pictures", pictures)

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.motion)

    def __iter__(self) -> Iterator[records.DemonstrationStep]:
        """Yield the steps."""
        return (self.step(k) for k in range(len(self)))

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know of it."""
        notes = list(self.motion.notes)
        if self.outcome.disagreement:
            notes.append(f"{self.outcome.disagreement}.")
        for camera in self.scenery.cameras.values():
            if camera.on_hand:
                Ts = self.scenery.T_table_base @ self.motion.Ts_base_ee @ camera.T_frame_cam
                under = int(np.sum(Ts[:, 2, 3] <= 0.0))
                if under:
                    notes.append(
                        f"the camera '{camera.name}' is inside the table in {under} of "
                        f"{len(self)} steps: the school knows of no camera on the hand."
                    )
        return tuple(notes)

    def step(self, k: int) -> records.DemonstrationStep:
        """Return one step.

        Raises:
            IndexError: there is none of that number.
        """
        if not 0 <= k < len(self):
            raise IndexError(f"step {k} of {len(self)}")
        m, scenery = self.motion, self.scenery
        after = min(k + 1, len(self) - 1)
        Ts_table_obj = {**scenery.Ts_table_obj, self.name.instance: m.Ts_table_obj[k]}
        T_base_table = se3.invert(scenery.T_table_base)
        return records.DemonstrationStep(
            index=k,
            time_s=float(m.time_s[k]),
            phase=records.ALL_PHASES[m.phase[k]],
            joints_rad=m.joints_rad[k],
            opening_m=float(m.opening_m[k]),
            held=bool(m.held[k]),
            T_base_ee=m.Ts_base_ee[k],
            Ts_base_obj={i: T_base_table @ T for i, T in Ts_table_obj.items()},
            action=records.RobotAction(
                joints_rad=m.joints_rad[after],
                opening_m=float(m.command_m[after]),
                T_ee_next=se3.invert(m.Ts_base_ee[k]) @ m.Ts_base_ee[after],
            ),
            picture=partial(self.pictures.picture, k),
            T_table_cam=partial(self.pictures.T_table_cam, k),
        )


class DemonstrationSource(Sequence[Demonstration]):
    """All attempts of a scene's school; each is replayed when it is asked for."""

    def __init__(
        self,
        grasps: SceneGrasps,
        models: Mapping[int, ObjectModel],
        config: records.DemonstrationConfig | None = None,
        *,
        cameras: Sequence[records.DemonstrationCamera | FrontView] | None = None,
        solids: Mapping[int, KnownSolid] | None = None,
        cache: Path | None = None,
    ) -> None:
        """Look at what is there; nothing is replayed yet.

        Args:
            grasps: the sets with their trajectories and poses (`app.school_files.stored_grasps`).
            models: the objects by id.
            config: rate of the steps.
            cameras: None = one beside the table, one in the hand. A `FrontView` is placed where
                it sees what happens.
            solids: convex parts and matter by object id, as far as a library knew them when the
                school was run.
            cache: folder of the school's convex parts (grasps/cache); None = they are computed.

        Raises:
            InputError: there is no table or no attempt, an object has no model or pose, or the
                sets do not say how they were made.
        """
        self.config = config or records.DemonstrationConfig()
        if not 1 <= self.config.rate_hz <= 240:
            raise InputError(
                f"{self.config.rate_hz} steps per second cannot be; 1 to 240 is accepted."
            )
        self._grasps, self._models, self._cache = grasps, models, cache
        self._solids = dict(solids or {})
        if grasps.T_world_table is None:
            raise InputError(
                f"the grasps of '{grasps.name}' do not say where the table is; run "
                "`realsim school` on a scene that has a plane."
            )
        self._sets = {s.instance: s for s in grasps.sets}
        self._check_objects()
        self.attempts = tuple(_attempts(grasps))
        self.not_attempted = tuple(_not_attempted(grasps))
        if not self.attempts:
            raise InputError(
                f"the grasps of '{grasps.name}' come without trajectories: no grasp was reachable, "
                "or the school was told not to keep them. There is nothing to demonstrate."
            )
        self._configs = {i: school_config_of(s) for i, s in self._sets.items()}
        first = self._configs[next(iter(self._sets))]
        self.arm: GraspingArm = grasping_arm(first.reach, first.hand)
        """The arm that attempted, with its hand."""
        self.scenery = self._scenery(cameras)
        self._bodies: dict[int, SlipBody] = {}
        self._stands: dict[int, Stand | None] = {}
        self._engine: tuple[object, RecordedEngine] | None = None

    def __len__(self) -> int:
        """Return the number of attempts."""
        return len(self.attempts)

    @overload
    def __getitem__(self, index: int) -> Demonstration: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Demonstration]: ...
    def __getitem__(self, index: int | slice) -> Demonstration | Sequence[Demonstration]:
        """Return an attempt, replayed; of a slice, all of it at once."""
        if isinstance(index, slice):
            return [self._replayed(name) for name in self.attempts[index]]
        return self._replayed(self.attempts[index])

    def stream(self, attempt: int) -> Iterator[records.DemonstrationStep]:
        """Yield the steps of an attempt; pictures are rendered as `look` is called.

        Raises:
            InputError: the scene is not the one that the grasps were tried in.
        """
        yield from self[attempt]

    def number_of(self, instance: int, grasp: int) -> int:
        """Return the number of the attempt at a grasp.

        Raises:
            InputError: there is no such object or grasp, or the arm did not attempt it.
        """
        name = AttemptName(instance=instance, grasp=grasp)
        if name in self.attempts:
            return self.attempts.index(name)
        for other in self.not_attempted:
            if (other.instance, other.grasp) == (instance, grasp):
                tried = [str(a.grasp) for a in self.attempts if a.instance == instance]
                raise InputError(
                    f"grasp {grasp} of instance {instance} has no attempt: {other.why}. Attempts "
                    f"there are at its grasps {', '.join(tried[:20]) or '(none)'}."
                )
        there = ", ".join(f"{i} ({len(s)} grasps)" for i, s in self._sets.items())
        raise InputError(f"there is no grasp {grasp} of instance {instance}; there are: {there}.")

    def goal(self, attempt: int) -> records.GraspGoal:
        """Return what an attempt is at, without replaying it."""
        name = self.attempts[attempt]
        s = self._sets[name.instance]
        T_table_grasp = self.scenery.Ts_table_obj[name.instance] @ s.Ts_obj_grasp[name.grasp]
        thing = self.scenery.models[name.instance].name
        return records.GraspGoal(
            obj_id=s.obj_id,
            instance=name.instance,
            name=thing,
            grasp=name.grasp,
            T_base_grasp=se3.invert(self.scenery.T_table_base) @ T_table_grasp,
            language=f"grasp the {in_words(thing)}",
        )

    def succeeded(self, attempt: int) -> bool:
        """Return whether an attempt passed all stages, as it is stored."""
        name = self.attempts[attempt]
        return bool(self._sets[name.instance].base_scores[name.grasp] == 1.0)

    def stored_joints(self, name: AttemptName) -> Array:
        """Return the planned joints (S, 7) of an attempt [rad]."""
        attempts = self._grasps.trajectories[name.instance]
        rows = attempts.attempt(name.grasp)
        assert rows is not None, "the name comes from the trajectories"
        return attempts.joints_rad[rows]

    # --- how ----------------------------------------------------------------------------------

    def _check_objects(self) -> None:
        """Raise if an object has no model, or no pose."""
        for s in self._sets.values():
            if s.obj_id not in self._models:
                raise InputError(
                    f"object {s.obj_id} (instance {s.instance}) has no model; without its mesh "
                    "nothing can be replayed."
                )
            if s.instance not in self._grasps.Ts_world_obj:
                raise InputError(
                    f"the pose of instance {s.instance} is not known; it has been taken out of the "
                    "scene since the school was run. Run `realsim school` again."
                )

    def _scenery(
        self, cameras: Sequence[records.DemonstrationCamera | FrontView] | None
    ) -> Scenery:
        assert self._grasps.T_world_table is not None, "the constructor has looked"
        T_table_world = se3.invert(self._grasps.T_world_table)
        first = next(iter(self._sets.values()))
        given = first.parameters.get("middle_xy_m")
        if not isinstance(given, list) or len(given) != 2:  # pyright: ignore[reportUnknownArgumentType]
            raise InputError(
                f"the grasps of instance {first.instance} do not say where the arm stood "
                "(parameters.middle_xy_m); run `realsim school` again."
            )
        middle = (float(given[0]), float(given[1]))  # pyright: ignore[reportUnknownArgumentType]
        models = {i: self._models[s.obj_id] for i, s in self._sets.items()}
        Ts_table_obj = {i: T_table_world @ self._grasps.Ts_world_obj[i] for i in self._sets}
        T_table_base = base_on_table(middle, self._configs[first.instance].reach, self.arm)
        usual = FrontView(), wrist_camera(hand=self.arm.hand)
        asked = usual if cameras is None else tuple(cameras)
        if len({c.name for c in asked}) != len(asked):
            raise InputError("two cameras have the same name; pictures would be mixed up.")
        seen = happening(self._grasps, models, Ts_table_obj, T_table_base, self.arm)
        chosen = [placed_front(c, seen) if isinstance(c, FrontView) else c for c in asked]
        drawn = {o: drawn_mesh(self._models[o].mesh) for o in {s.obj_id for s in self._grasps.sets}}
        by_name = {c.name: c for c in chosen}
        looks = {i: (drawn[s.obj_id], Ts_table_obj[i]) for i, s in self._sets.items()}
        return Scenery(
            cameras=by_name,
            models=models,
            Ts_table_obj=Ts_table_obj,
            T_table_base=T_table_base,
            arm=self.arm,
            pictures=ScenePictures(by_name, looks, self.arm, T_table_base, middle),
        )

    def _replayed(self, name: AttemptName) -> Demonstration:
        """Return an attempt, replayed."""
        s, config = self._sets[name.instance], self._configs[name.instance]
        attempts = self._grasps.trajectories[name.instance]
        tried = self._body(name.instance)
        T_table_obj = self.scenery.Ts_table_obj[name.instance]
        replay = replay_grasp(
            s, name.grasp, self.stored_joints(name)[-1], T_table_obj, tried, config,
            self._recorder(name.instance), self._stand(name.instance),
        )  # fmt: skip
        attempt = Attempt(
            arm=self.arm,
            trajectories=attempts,
            row=name.grasp,
            replay=replay,
            body=tried,
            T_table_base=self.scenery.T_table_base,
            T_table_obj=T_table_obj,
            others=[
                se3.transform(T, self.scenery.models[i].mesh.vertices)
                for i, T in self.scenery.Ts_table_obj.items()
                if i != name.instance
            ],
            closing_speed=min(config.reach.timing.close_speed, config.hand.closing_speed),
        )
        motion = attempt_motion(attempt, self.config.rate_hz, self.config.fall_s)
        return Demonstration(
            name=name,
            goal=self.goal(self.attempts.index(name)),
            outcome=records.AttemptOutcome(
                success=not s.failures[name.grasp],
                stages_passed=round(STAGES_IN_ALL * float(s.base_scores[name.grasp])),
                score=float(s.scores[name.grasp]),
                failure=s.failures[name.grasp],
                agrees=replay.agrees,
                disagreement=replay.disagreement,
                labels={
                    n: to_json(s.measures[n][name.grasp]) for n in LABEL_MEASURES if n in s.measures
                },
            ),
            motion=motion,
            scenery=self.scenery,
        )

    def _body(self, instance: int) -> SlipBody:
        """Return an object as the engine had it."""
        if instance not in self._bodies:
            s = self._sets[instance]
            self._bodies[instance] = tried_body(
                s,
                self._models[s.obj_id],
                self.scenery.Ts_table_obj[instance],
                self._configs[instance],
                self._solids.get(s.obj_id),
                self._cache,
            )
        return self._bodies[instance]

    def _stand(self, instance: int) -> Stand | None:
        """Return what an object stood on while the fingers closed.

        Of neighbours only those are known whose grasps are; whether it mattered is told by
        whether the replay ends as the attempt did.
        """
        if instance not in self._stands:
            pieces: list[Array] = []
            for i, T in self.scenery.Ts_table_obj.items():
                if i != instance:
                    tried = "convex" in self._sets[i].parameters
                    mesh = self.scenery.models[i].mesh
                    own = self._body(i).parts if tried else (hull_vertices(mesh.vertices),)
                    pieces += [se3.transform(T, part) for part in own]
            self._stands[instance] = stand_of(
                self._configs[instance].slip,
                self.scenery.Ts_table_obj[instance],
                self._body(instance),
                pieces,
            )
        return self._stands[instance]

    def _recorder(self, instance: int) -> RecordedEngine:
        """Return an engine of an instance's settings; the last one is kept."""
        settings = self._configs[instance].slip.engine
        if self._engine is None or self._engine[0] != settings:
            self._engine = (settings, RecordedEngine(make_engine(settings)))
        return self._engine[1]


def _attempts(grasps: SceneGrasps) -> Iterator[AttemptName]:
    """Yield the attempts, object by object; a grasp that was not judged is none."""
    for s in grasps.sets:
        there = grasps.trajectories.get(s.instance)
        for row in [] if there is None else there.rows.tolist():
            if not np.isnan(s.scores[row]):
                yield AttemptName(instance=s.instance, grasp=row)


def _not_attempted(grasps: SceneGrasps) -> Iterator[NotAttempted]:
    """Yield the grasps without an attempt, and why."""
    there = {(a.instance, a.grasp) for a in _attempts(grasps)}
    for s in grasps.sets:
        for row in range(len(s)):
            if (s.instance, row) not in there:
                why = s.failures[row] or "its trajectory was not kept"
                yield NotAttempted(instance=s.instance, grasp=row, why=why)


def in_words(name: str) -> str:
    """Return an object's name as it is spoken: '003_cracker_box' -> 'cracker box'."""
    words = re.sub(r"[\s_\-]+", " ", name).strip()
    return re.sub(r"^\d+ (?=\D)", "", words) or "object"
