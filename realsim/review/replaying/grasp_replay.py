"""The replay of a grasp in the review: what arm, fingers and object do, over time.

    player = ReplayPlayer(client.scene, client.gui, motions, atomic=client.atomic)
    player.show(instance, row)

Where the motion comes from is the caller's business (`Motions`). What the browser is sent while it
plays are positions and orientations of a dozen nodes; the meshes go over once.
"""

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import viser

from realsim.arrays import Array, Int64
from realsim.errors import InputError
from realsim.records import Mesh
from realsim.records.checked_arrays import freeze, frozen
from realsim.records.grasps import PHASES
from realsim.review.replaying.grasp_words import escaped
from realsim.review.replaying.replay_nodes import ReplayNodes
from realsim.robots.hand import Hand, find_hand

SPEEDS = ("0.25x", "0.5x", "1x", "2x", "4x")
PHASE_WORDS = {
    "reach": "reach: from home to before the grasp",
    "approach": "approach: straight on",
    "close": "close: the fingers close",
    "lift": "lift",
    "oscillate": "oscillate: shaken",
    "pendulum": "pendulum: swung",
}
"""The phases as a person reads them."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class GraspMotion:
    """A grasp over S samples, in world."""

    instance: int
    row: int
    """Row of the instance's grasp set."""
    time_s: Array
    """(S,) since the beginning [s], increasing."""
    Ts_world_hand: Array
    """(S, 4, 4) the hand's grasp frame [m]."""
    opening_m: Array
    """(S,) distance of the finger faces [m]."""
    phase: Int64
    """(S,) number in PHASES."""
    Ts_world_obj: Array
    """(S, 4, 4) the grasped object [m]."""
    obj_mesh: Mesh | None = None
    """What is drawn of it while it is carried; None = nothing."""
    Ts_world_link: Array = field(default_factory=lambda: np.zeros((0, 0, 4, 4)))
    """(S, L, 4, 4) arm and hand as they are drawn [m]; L = 0 = a plain hand of boxes alone."""
    link_meshes: tuple[Mesh, ...] = ()
    """(L,) their meshes."""
    arm_links: int = 0
    """How many of the first links are the arm, which a person may hide: it is often in the way."""
    hand: Hand = field(default_factory=find_hand)
    """Drawn as plain boxes where the links hold no hand."""
    notes: tuple[str, ...] = ()
    """What a person should know of it."""

    def __post_init__(self) -> None:
        """Check that all arrays speak of the same samples, and freeze them.

        Raises:
            InputError: they do not, or the time does not increase.
        """
        s, links = len(self.time_s), len(self.link_meshes)
        if s == 0:
            raise InputError("the motion of the grasp has no sample; at least one is expected.")
        given = self.Ts_world_link if links else np.zeros((s, 0, 4, 4))
        object.__setattr__(
            self, "Ts_world_link", frozen(given, np.float64, (s, links, 4, 4), "Ts_world_link")
        )
        freeze(self, time_s=(s,), opening_m=(s,), Ts_world_hand=(s, 4, 4), Ts_world_obj=(s, 4, 4))
        freeze(self, np.int64, phase=(s,))
        if np.any(np.diff(self.time_s) <= 0):
            raise InputError("the times of the motion do not increase; each sample needs its own.")
        if not (self.phase.min() >= 0 and self.phase.max() < len(PHASES)):
            raise InputError(f"a phase is not one of 0 to {len(PHASES) - 1}: {', '.join(PHASES)}.")

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.time_s)

    def at(self, time_s: float) -> int:
        """Return the number of the last sample that is not after a time [s]."""
        found = int(np.searchsorted(self.time_s, time_s + 1e-9, side="right")) - 1
        return int(np.clip(found, 0, len(self) - 1))

    def phase_name(self, sample: int) -> str:
        """Return the phase of a sample."""
        return PHASES[int(self.phase[sample])]


class Motions(Protocol):
    """Where the motion of a grasp comes from."""

    def motion(self, instance: int, row: int) -> GraspMotion | None:
        """Return what is replayed of a row of an instance's grasp set; None = nothing is known.

        Raises:
            InputError: what is stored of it cannot be read.
        """
        ...


APPROACH_M = 0.08
"""Length of the straight way of a hand without an arm [m]: the school's own."""
SPEED_M_S = 0.10
"""Speed of that hand [m/s]."""
CLOSING_M_S = 0.05
"""Speed of each finger [m/s]: Franka's hand at its usual speed."""
RATE_HZ = 20
"""Frames per second: the school looks as often, and a dozen nodes a frame are 30 kB/s."""


def hand_approach(
    instance: int,
    row: int,
    T_world_obj: Array,
    T_obj_grasp: Array,
    width_m: float,
    hand: Hand,
    *,
    obj_mesh: Mesh | None = None,
    notes: tuple[str, ...] = (),
) -> GraspMotion:
    """Return how a hand comes to a grasp and closes; made from the grasp alone.

    Args:
        instance: the object.
        row: the grasp's row.
        T_world_obj: (4, 4) where the object stands [m].
        T_obj_grasp: (4, 4) the grasp [m].
        width_m: distance of the contacts [m]: the fingers stop there.
        hand: what closes, from fully open.
        obj_mesh: the object's mesh.
        notes: what is said of the motion.
    """
    opened = max(hand.max_opening_m, width_m)
    arrive = APPROACH_M / SPEED_M_S
    end = arrive + (opened - width_m) / (2.0 * CLOSING_M_S)
    # Both ends are samples: the grasp itself and the closed hand are shown exactly.
    grid = np.arange(0.0, end, 1.0 / RATE_HZ)
    t = np.unique(np.concatenate([grid, [arrive, end]])).astype(np.float64)
    t = t[np.append(np.diff(t) > 1e-6, True)]
    back = np.maximum(APPROACH_M - SPEED_M_S * t, 0.0)
    back[t >= arrive - 1e-9] = 0.0
    Ts_grasp_hand = np.tile(np.eye(4), (len(t), 1, 1))
    Ts_grasp_hand[:, 2, 3] = -back
    closing = t >= arrive - 1e-9
    opening = opened - 2.0 * CLOSING_M_S * np.maximum(t - arrive, 0.0)
    return GraspMotion(
        instance=instance,
        row=row,
        time_s=t,
        Ts_world_hand=T_world_obj @ T_obj_grasp @ Ts_grasp_hand,
        opening_m=np.maximum(opening, width_m),
        phase=np.where(closing, PHASES.index("close"), PHASES.index("approach")),
        Ts_world_obj=np.tile(T_world_obj, (len(t), 1, 1)),
        obj_mesh=obj_mesh,
        hand=hand,
        notes=notes,
    )


SLIDER_HZ = 4.0
"""How often the slider follows [1/s]: it tells where one is, the scene tells the rest."""


class ReplayPlayer:
    """The controls of a replay and its nodes, for one browser or for all."""

    def __init__(
        self,
        scene: viser.SceneApi,
        gui: viser.GuiApi,
        motions: Motions,
        *,
        atomic: Callable[[], contextlib.AbstractContextManager[Any]] = contextlib.nullcontext,
        connected: Callable[[], bool] = lambda: True,
        on_carried: Callable[[int, bool], None] | None = None,
        name: str = "/replay",
    ) -> None:
        """Build the controls, hidden until a grasp is chosen.

        Args:
            scene: of the server, or of one client.
            gui: likewise; the controls go into the container that is open.
            motions: where motions come from.
            atomic: groups the updates of a frame (`client.atomic`).
            connected: whether the browser is still there; asked before each frame.
            on_carried: told when an object is carried off (instance, True) and stands again
                (instance, False): the caller may hide the one that stays behind.
            name: of the node under which everything is drawn.
        """
        self._motions = motions
        self._atomic, self._connected, self._on_carried = atomic, connected, on_carried
        self._closed: list[Callable[[], None]] = []
        self._nodes = ReplayNodes(scene, name)
        self._lock = threading.RLock()
        self._motion: GraspMotion | None = None
        self._time = 0.0
        self._carried = False
        self._stop: threading.Event | None = None
        """Ends the thread that plays; None = nothing plays."""
        self._folder = gui.add_folder("Replay of the grasp", visible=False)
        with self._folder:
            self._text = gui.add_markdown("")
            self._slider = gui.add_slider("Time [s]", 0.0, 1.0, 0.01, 0.0)
            self._buttons = gui.add_button_group("Replay", ("Play", "Pause", "Close"))
            self._speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1x")
            # An arm stands between the object and whoever looks from its side.
            self._arm = gui.add_checkbox("Show the arm", False, visible=False)
        self._slider.on_update(self._slid)
        self._buttons.on_click(self._pressed)
        self._arm.on_update(lambda _: self._nodes.show_arm(self._arm.value))

    def on_closed(self, callback: Callable[[], None]) -> None:
        """Have a function called when a motion that was shown is taken away."""
        self._closed.append(callback)

    @property
    def motion(self) -> GraspMotion | None:
        """The motion that is shown."""
        return self._motion

    @property
    def playing(self) -> bool:
        """Whether it runs."""
        return self._stop is not None

    @property
    def time_s(self) -> float:
        """Where it is [s]."""
        return self._time

    def show(self, instance: int, row: int, *, play: bool = True) -> GraspMotion | None:
        """Draw the motion of a grasp in place of the one before, and play it.

        Args:
            instance: the object.
            row: of its grasp set.
            play: whether it starts at once.

        Returns:
            The motion; None where nothing is known of this grasp (the replay is hidden then).

        Raises:
            InputError: what is stored of it cannot be read.
        """
        self.clear()
        motion = self._motions.motion(instance, row)
        if motion is None:
            return None
        with self._lock:
            self._motion, self._time = motion, 0.0
            self._nodes.draw(motion.link_meshes, motion.obj_mesh, motion.hand, motion.arm_links)
            self._nodes.show_arm(self._arm.value)
            self._arm.visible = motion.arm_links > 0
            self._slider.max = max(round(float(motion.time_s[-1]), 2), 0.01)
            self._folder.visible = True
            self._draw(slider=True)
        if play:
            self.play()
        return motion

    def play(self) -> None:
        """Go on; from the beginning if it is at the end."""
        with self._lock:
            if self._motion is None or self._stop is not None:
                return
            if self._time >= self._motion.time_s[-1]:
                self._time = 0.0
            self._stop = threading.Event()
            thread = threading.Thread(
                target=self._run, args=(self._motion, self._stop), name="grasp-replay", daemon=True
            )
        thread.start()

    def pause(self) -> None:
        """Stop where it is."""
        with self._lock:
            if self._stop is not None:
                self._stop.set()
                self._stop = None

    def seek(self, time_s: float) -> None:
        """Go to a time [s], and stay there."""
        self._seek(time_s, slider=True)

    def clear(self) -> None:
        """Take everything away; what was carried stands again."""
        self.pause()
        with self._lock:
            was_shown = self._motion is not None
            self._carry(False)
            self._motion = None
            self._nodes.clear()
            self._folder.visible = False
        for told in self._closed if was_shown else ():
            told()

    # --- how ----------------------------------------------------------------------------------

    def _seek(self, time_s: float, slider: bool) -> None:
        self.pause()
        with self._lock:
            if self._motion is not None:
                self._time = float(np.clip(time_s, 0.0, self._motion.time_s[-1]))
                self._draw(slider=slider)

    def _run(self, motion: GraspMotion, stop: threading.Event) -> None:
        """Play until the end, until it is stopped, or until the browser is gone."""
        step, last = 1.0 / RATE_HZ, time.monotonic()
        slider_due = 0.0
        while not stop.wait(step):
            if not self._connected():
                self.pause()
                return
            now = time.monotonic()
            with self._lock:
                if stop.is_set() or self._motion is not motion:
                    return
                self._time += (now - last) * float(self._speed.value.rstrip("x"))
                at_end = self._time >= motion.time_s[-1]
                self._time = min(self._time, float(motion.time_s[-1]))
                due = at_end or now >= slider_due
                slider_due = now + 1.0 / SLIDER_HZ if due else slider_due
                self._draw(slider=due)
                if at_end:
                    self._stop = None
                    return
            last = now

    def _draw(self, slider: bool) -> None:
        """Put everything where it is at this time."""
        motion = self._motion
        assert motion is not None, "the callers have looked"
        k = motion.at(self._time)
        T_obj = motion.Ts_world_obj[k]
        self._carry(not np.allclose(T_obj, motion.Ts_world_obj[0], rtol=0.0, atol=CARRIED))
        with self._atomic():
            self._nodes.put(
                motion.Ts_world_link[k],
                motion.Ts_world_hand[k],
                float(motion.opening_m[k]),
                T_obj if self._carried else None,
            )
        text = _text(motion, k)
        if self._text.content != text:
            self._text.content = text
        if slider:
            self._slider.value = round(min(self._time, float(self._slider.max)), 2)

    def _carry(self, carried: bool) -> None:
        if carried != self._carried and self._motion is not None:
            self._carried = carried
            if self._on_carried is not None:
                self._on_carried(self._motion.instance, carried)

    def _slid(self, event: Any) -> None:
        # The thread moves the slider as well; only a person's hand counts.
        if event.client is not None:
            # It is where the hand put it; moved back to a sample it would jerk.
            self._seek(float(self._slider.value), slider=False)

    def _pressed(self, _: Any) -> None:
        word = self._buttons.value
        if word == "Play":
            self.play()
        elif word == "Pause":
            self.pause()
        else:
            self.clear()


CARRIED = 1e-5
"""A pose that differs by more than this from where the object stood is carried [m, 1]."""


def _text(motion: GraspMotion, sample: int) -> str:
    """Return what stands over the controls."""
    lines = [f"**{PHASE_WORDS[motion.phase_name(sample)]}**"]
    lines += [f"- {escaped(note)}" for note in motion.notes]
    return "\n".join(lines)
