"""An engine of the slip test that writes down where the objects were.

It stands between the slip test and a real engine and passes everything on unchanged, so that a
grasp that is tried again with it ends as it did; what the test itself does not keep, the poses at
each look, is kept here.
"""

from contextlib import ExitStack
from dataclasses import dataclass, field
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from realsim_sim_bridge.grasping.hand import HandGeometry
from realsim_sim_bridge.slip.body import SlipBody
from realsim_sim_bridge.slip.world import (
    Closing,
    Engine,
    Grips,
    HandWorld,
    Motion,
    PairStates,
    Replay,
    SlipPhysics,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class StageRecord:
    """One stage of one pair, as an engine played it."""

    motion: Motion
    """What was seen."""
    fingers_m: Array
    """(2,) distance of each finger's face from the middle at the end [m]; NaN = not known."""
    speed: int
    """How many times as fast as they were the loads were played."""


class RecordedEngine:
    """An `Engine` for one grasp at a time."""

    def __init__(self, engine: Engine) -> None:
        """Stand in front of an engine."""
        self._engine = engine
        self.stages: list[StageRecord] = []
        """What was played of the last grasp, stage by stage."""
        self._worlds = 0

    @property
    def name(self) -> str:
        """The engine's name."""
        return self._engine.name

    @property
    def pairs_per_world(self) -> int:
        """The engine's own."""
        return self._engine.pairs_per_world

    @property
    def replay(self) -> Replay:
        """The engine's own."""
        return self._engine.replay

    def version(self) -> str:
        """Return the engine's version."""
        return self._engine.version()

    def begin(self) -> None:
        """Forget the grasp before."""
        self.stages = []
        self._worlds = 0

    def world(
        self, body: SlipBody, grips: Grips, physics: SlipPhysics, geometry: HandGeometry
    ) -> HandWorld:
        """Return the engine's world, watched.

        The slip test's first world goes through the stages; a later one plays its latest stage
        again, at true speed.
        """
        self._worlds += 1
        again = self._worlds > 1
        world = self._engine.world(body, grips, physics, geometry)
        return _RecordedWorld(world, self.stages, 1 if again else self.replay.speed, again)


@dataclass(eq=False)
class _RecordedWorld(HandWorld):
    """A `HandWorld` whose plays are written down."""

    inner: HandWorld
    stages: list[StageRecord]
    speed: int
    again: bool
    _stack: ExitStack = field(default_factory=ExitStack)

    def __post_init__(self) -> None:
        """Take over the time step."""
        self.dt = self.inner.dt

    @property
    def alive(self) -> Mask:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The inner world's."""
        return self.inner.alive

    def __enter__(self) -> "_RecordedWorld":
        """Enter the inner world."""
        self._stack.enter_context(self.inner)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave it."""
        self._stack.__exit__(kind, error, trace)

    def close(self, closing: Closing) -> Motion:
        """Close the hands and write it down."""
        motion = self.inner.close(closing)
        self._note(motion, 1)
        return motion

    def play(self, wrenches: Array, sample: int, lost_m: float) -> Motion:
        """Play a stage and write it down, in place of what was played too fast."""
        motion = self.inner.play(wrenches, sample, lost_m)
        if self.again:
            self.stages.pop()
        self._note(motion, self.speed)
        return motion

    def _note(self, motion: Motion, speed: int) -> None:
        fingers = self.inner.states().fingers_m[0]
        self.stages.append(StageRecord(motion=motion, fingers_m=fingers, speed=speed))

    def states(self) -> PairStates:
        """Return the inner world's states."""
        return self.inner.states()

    def put(self, states: PairStates) -> None:
        """Put the pairs of the inner world there."""
        self.inner.put(states)

    def remove(self, rows: Mask) -> None:
        """Take pairs out of the inner world."""
        self.inner.remove(rows)

    def settings(self) -> dict[str, float]:
        """Return the inner world's settings."""
        return self.inner.settings()
