"""Motions of a session's grasps for the review: what the school's arm did, as far as it is stored.

    stored trajectory, scene as it was tried   the attempt itself, tried again (`demonstrations`)
    stored trajectory, attempt not repeatable  arm as stored, the object fixed in the hand
    anything else                              the hand's approach alone, made from the grasp

Which of the three it is stands in the motion's notes.
"""

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from realsim.arrays import Array, Int64
from realsim.errors import InputError, RealsimError
from realsim.formats.grasps.hand_frames import hand_of_set
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.geometry import se3
from realsim.records import STAGES, GraspSet, Mesh, ObjectModel
from realsim.records.grasps import PHASES, GraspTrajectories
from realsim.review.replaying.grasp_replay import RATE_HZ, GraspMotion, hand_approach
from realsim.robots.hand import FRANKA, find_hand
from realsim_sim_bridge.arm.grasping_arm import GraspingArm
from realsim_sim_bridge.arm.reach_config import base_on_table, grasping_arm
from realsim_sim_bridge.demonstrations.pictures import drawn_mesh, hand_meshes, robot_meshes
from realsim_sim_bridge.demonstrations.records import DemonstrationConfig
from realsim_sim_bridge.demonstrations.school_settings import school_config_of
from realsim_sim_bridge.demonstrations.source import DemonstrationSource

NO_TRAJECTORY = "no arm trajectory stored: the hand's approach only"
FIXED_IN_HAND = "the object is drawn as if it were fixed in the hand"
SAME_GRASP = 1e-5
"""Largest difference of the stored arm's hand at closure from the grasp [m, 1]: ten times the error
that the school allows a followed pose, for the rounding of the files."""
KEPT = 16
"""Motions kept: going back to a grasp costs nothing."""
CLOSE = PHASES.index("close")


class SessionMotions:
    """`realsim.review.replaying.grasp_replay.Motions` of a school's results."""

    def __init__(
        self,
        grasps: SceneGrasps,
        models: Mapping[int, ObjectModel],
        *,
        cache: Path | None = None,
        with_arm: bool = True,
    ) -> None:
        """Look at what is there; nothing is replayed yet.

        Args:
            grasps: sets, trajectories and poses (`app.school.files.stored_grasps`).
            models: the objects by id.
            cache: the school's folder of convex parts (grasps/cache); None = they are computed.
            with_arm: whether arm and hand are drawn by their meshes (a plain hand otherwise).
        """
        self._grasps, self._models = grasps, models
        self._sets = {s.instance: s for s in grasps.sets}
        self._with_arm = with_arm
        self._lock = threading.RLock()
        self._kept: OrderedDict[tuple[int, int], GraspMotion] = OrderedDict()
        self._drawn: dict[int, Mesh] = {}
        self._source: DemonstrationSource | None = None
        self._no_source = ""
        try:
            self._source = DemonstrationSource(
                grasps, models, DemonstrationConfig(rate_hz=RATE_HZ), cameras=(), cache=cache
            )
        except InputError as error:
            self._no_source = str(error)

    @classmethod
    def of_session(cls, folder: Path, *, with_arm: bool = True) -> "SessionMotions":
        """Return the motions of a session or of a folder of the school's results.

        Raises:
            InputError: there are no grasps, or what is stored is broken.
        """
        from realsim.app.school.files import GRASPS, stored_grasps

        grasps, models = stored_grasps(folder)
        return cls(grasps, models, cache=folder / GRASPS / "cache", with_arm=with_arm)

    def motion(self, instance: int, row: int) -> GraspMotion | None:
        """Return the motion of a grasp; None where there is no such grasp, or its object no pose.

        Raises:
            InputError: the object has no model.
        """
        s = self._sets.get(instance)
        if s is None or not 0 <= row < len(s) or instance not in self._grasps.Ts_world_obj:
            return None
        if s.obj_id not in self._models:
            raise InputError(
                f"object {s.obj_id} (instance {instance}) has no model; without its mesh no grasp "
                "of it can be shown."
            )
        with self._lock:
            key = (instance, row)
            if key not in self._kept:
                self._kept[key] = self._made(s, row)
                if len(self._kept) > KEPT:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            return self._kept[key]

    # --- how ----------------------------------------------------------------------------------

    def _made(self, s: GraspSet, row: int) -> GraspMotion:
        attempts = self._grasps.trajectories.get(s.instance)
        samples = None if attempts is None else attempts.attempt(row)
        if attempts is None or samples is None or samples.start == samples.stop:
            return self._approach(s, row, (NO_TRAJECTORY,))
        why = self._no_source
        if self._source is not None:
            try:
                return self._tried_again(self._source, s, row)
            except InputError as error:
                why = str(error)
        try:
            return self._as_stored(s, row, attempts, why)
        except InputError as error:
            return self._approach(s, row, (f"the hand's approach only: {error}",))

    def _tried_again(self, source: DemonstrationSource, s: GraspSet, row: int) -> GraspMotion:
        """Return the attempt as the school made it, object and all.

        Raises:
            InputError: it was not judged, or the scene is another one than it was tried in.
        """
        demonstration = source[source.number_of(s.instance, row)]
        m, scenery = demonstration.motion, demonstration.scenery
        T_world_table = self._table()
        T_world_base = T_world_table @ scenery.T_table_base
        arm = scenery.arm
        meshes, Ts_world_link, links = self._drawn_arm(arm, m.joints_rad, m.opening_m, T_world_base)
        return GraspMotion(
            instance=s.instance, row=row, time_s=m.time_s,
            Ts_world_hand=T_world_base @ m.Ts_base_ee, opening_m=m.opening_m, phase=m.phase,
            Ts_world_obj=T_world_table @ m.Ts_table_obj, obj_mesh=self._mesh(s.obj_id),
            Ts_world_link=Ts_world_link, link_meshes=meshes, arm_links=links, hand=arm.hand,
            notes=demonstration.notes,
        )  # fmt: skip

    def _as_stored(
        self, s: GraspSet, row: int, attempts: GraspTrajectories, why: str
    ) -> GraspMotion:
        """Return the arm's stored motion; the object goes along rigidly while it was held.

        Raises:
            InputError: where the arm stood is not known, or the object does not stand there any
                more.
        """
        samples = attempts.attempt(row)
        assert samples is not None, "the caller has looked"
        times, phases = attempts.time_s[samples], attempts.phase[samples]
        end = _shown_until(s, row, times, phases)
        t = np.append(np.arange(0.0, end - 1e-6, 1.0 / RATE_HZ), end)
        joints = np.stack([np.interp(t, times, q) for q in attempts.joints_rad[samples].T], axis=1)
        opening = np.interp(t, times, attempts.opening_m[samples])
        at = np.clip(np.searchsorted(times, t + 1e-9, side="right") - 1, 0, len(times) - 1)
        T_table_base, arm = _base_of(s)
        T_world_base = self._table() @ T_table_base
        Ts_world_hand = T_world_base @ arm.forward(joints)
        T_world_obj = self._grasps.Ts_world_obj[s.instance]
        T_world_grasp = T_world_obj @ s.Ts_obj_grasp[row]
        closed = phases[at] >= CLOSE
        first = int(np.argmax(closed))
        if not closed.any() or not np.allclose(
            Ts_world_hand[first], T_world_grasp, rtol=0.0, atol=SAME_GRASP
        ):
            raise InputError(
                "the object has been moved since its grasps were tried; run `realsim school` again"
            )
        lifted = phases[at] > CLOSE
        Ts_world_obj = np.tile(T_world_obj, (len(t), 1, 1))
        Ts_world_obj[lifted] = Ts_world_hand[lifted] @ se3.invert(s.Ts_obj_grasp[row])
        width: Array = np.where(closed, np.maximum(opening, s.widths_m[row]), opening)
        meshes, Ts_world_link, links = self._drawn_arm(arm, joints, width, T_world_base)
        return GraspMotion(
            instance=s.instance, row=row, time_s=t, Ts_world_hand=Ts_world_hand, opening_m=width,
            phase=phases[at], Ts_world_obj=Ts_world_obj, obj_mesh=self._mesh(s.obj_id),
            Ts_world_link=Ts_world_link, link_meshes=meshes, arm_links=links, hand=arm.hand,
            notes=(f"{FIXED_IN_HAND}: {why}",),
        )  # fmt: skip

    def _approach(self, s: GraspSet, row: int, notes: tuple[str, ...]) -> GraspMotion:
        """Return the hand's approach, with the hand's meshes."""
        made = hand_approach(
            s.instance, row, self._grasps.Ts_world_obj[s.instance], s.Ts_obj_grasp[row],
            float(s.widths_m[row]), hand_of_set(s),
            obj_mesh=self._mesh(s.obj_id), notes=notes,
        )  # fmt: skip
        if not self._with_arm or s.hand[0] != FRANKA:
            return made
        try:
            meshes, Ts = hand_meshes(find_hand(), made.Ts_world_hand, made.opening_m)
        except (RealsimError, ImportError):
            return made
        return replace(made, link_meshes=meshes, Ts_world_link=Ts)

    def _drawn_arm(
        self, arm: GraspingArm, joints: Array, opening_m: Array, T_world_base: Array
    ) -> tuple[tuple[Mesh, ...], Array, int]:
        """Return arm and hand as they are drawn, and how many meshes are the arm's.

        There are none where they cannot be read; hands but Franka's are drawn as their boxes.
        """
        if self._with_arm:
            with contextlib.suppress(RealsimError, ImportError):
                meshes, Ts = robot_meshes(arm, joints, opening_m, T_world_base)
                hand, _ = hand_meshes(arm.hand, Ts[:1, -1], opening_m[:1])
                links = len(meshes) - len(hand)
                shown = len(meshes) if arm.hand.name == FRANKA else links
                return meshes[:shown], Ts[:, :shown], links
        return (), np.zeros((len(joints), 0, 4, 4)), 0

    def _table(self) -> Array:
        """Return T_world_table (4, 4).

        Raises:
            InputError: it is not known.
        """
        if self._grasps.T_world_table is None:
            raise InputError("the scene has no table, so that the arm's place is not known")
        return self._grasps.T_world_table

    def _mesh(self, obj_id: int) -> Mesh:
        if obj_id not in self._drawn:
            self._drawn[obj_id] = drawn_mesh(self._models[obj_id].mesh)
        return self._drawn[obj_id]


def _base_of(s: GraspSet) -> tuple[Array, GraspingArm]:
    """Return T_table_base (4, 4) of the arm that a set was tried with, and the arm.

    Raises:
        InputError: the set does not say.
    """
    middle: object = s.parameters.get("middle_xy_m")
    if not isinstance(middle, list) or len(middle) != 2:  # pyright: ignore[reportUnknownArgumentType]
        raise InputError(f"the grasps of instance {s.instance} do not say where the arm stood")
    x, y = (float(v) for v in middle)  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
    config = school_config_of(s)
    arm = grasping_arm(config.reach, config.hand)
    return base_on_table((x, y), config.reach, arm), arm


def _shown_until(s: GraspSet, row: int, times: Array, phases: Int64) -> float:
    """Return when the last stage that was passed ends [s]: beyond it, the hand lost the object."""
    base = float(np.nan_to_num(s.base_scores[row]))
    # Before anything is passed, the closing hand is shown.
    last = CLOSE + max(round(base * len(STAGES)) - 1, 0)
    return float(times[phases <= last][-1])
