"""What a LeRobot data set is written from: episodes that come one after the other."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError

Rgb = NDArray[np.uint8]
DTYPES = ("float32", "int64", "bool")
GIVEN_BY_WRITER = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Columns that every data set has; the writer fills them."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LeRobotFeature:
    """One column of numbers: a row of them at every step."""

    dtype: str
    """'float32', 'int64' or 'bool'."""
    names: tuple[str, ...] = ()
    """Of its numbers; () = one number without a name of its own."""

    def __post_init__(self) -> None:
        """Check the type.

        Raises:
            InputError: it is none that a column may have.
        """
        if self.dtype not in DTYPES:
            raise InputError(f"a column cannot be '{self.dtype}'; there are: {', '.join(DTYPES)}.")

    @property
    def width(self) -> int:
        """How many numbers a row has."""
        return max(1, len(self.names))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LeRobotEpisode:
    """One episode of S steps."""

    task: str
    """In words."""
    columns: Mapping[str, NDArray[Any]]
    """(S,) or (S, width) of every feature."""
    frames: Iterator[Mapping[str, Rgb]]
    """The pictures (H, W, 3) of every camera, step by step; taken once, one at a time."""
    notes: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """What else is known of it, as plain JSON values; kept in realsim/episodes.jsonl."""


class LeRobotSource(Protocol):
    """Episodes of one robot."""

    @property
    def name(self) -> str:
        """What messages call it."""
        ...

    @property
    def robot_type(self) -> str:
        """As LeRobot names it, such as 'panda'."""
        ...

    @property
    def fps(self) -> int:
        """Steps per second."""
        ...

    @property
    def features(self) -> Mapping[str, LeRobotFeature]:
        """The columns, in the order of the file."""
        ...

    @property
    def cameras(self) -> Mapping[str, tuple[int, int]]:
        """Key of each camera, such as observation.images.wrist -> height and width [px]."""
        ...

    @property
    def tasks(self) -> Sequence[str]:
        """All tasks in words, each once."""
        ...

    def __len__(self) -> int:
        """Return the number of episodes."""
        ...

    def episode(self, k: int) -> LeRobotEpisode:
        """Return an episode; the same each time it is asked for."""
        ...


def check_source(source: LeRobotSource) -> None:
    """Raise if a source cannot be written.

    Raises:
        InputError: a name that LeRobot does not take, an odd picture size, a rate that is none.
    """
    if not len(source):
        raise InputError(f"'{source.name}' has no episode; there is nothing to write.")
    if not 1 <= source.fps <= 240:
        raise InputError(f"{source.fps} steps per second cannot be; 1 to 240 is accepted.")
    for key in (*source.features, *source.cameras):
        if "/" in key or key in GIVEN_BY_WRITER:
            raise InputError(
                f"a column cannot be called '{key}': LeRobot takes no '/', and "
                f"{', '.join(GIVEN_BY_WRITER)} are written by themselves."
            )
    for key, (height, width) in source.cameras.items():
        if height % 2 or width % 2 or min(height, width) < 16:
            raise InputError(
                f"the pictures of '{key}' are {width} x {height} px; a video needs even numbers of "
                "16 or more."
            )
    if len(set(source.tasks)) != len(source.tasks):
        raise InputError(f"the tasks of '{source.name}' are not each named once.")


def checked_columns(source: LeRobotSource, k: int, episode: LeRobotEpisode) -> dict[str, Any]:
    """Return an episode's columns in their types, (S,) or (S, width).

    Raises:
        InputError: one is missing, of another length or width, or not finite; or the task is new.
    """
    where = f"episode {k} of '{source.name}'"
    if episode.task not in source.tasks:
        raise InputError(f"{where} has the task '{episode.task}', which is not among its tasks.")
    differing = sorted(set(source.features) ^ set(episode.columns))
    if differing:
        raise InputError(f"{where} differs from the features in: {', '.join(differing)}.")
    lengths = {len(v) for v in episode.columns.values()}
    if len(lengths) != 1 or 0 in lengths:
        raise InputError(f"{where} has columns of {sorted(lengths)} steps; one length is expected.")
    steps = lengths.pop()
    out: dict[str, Any] = {}
    for key, feature in source.features.items():
        value = np.asarray(episode.columns[key])
        shape = (steps, feature.width) if feature.width > 1 else (steps,)
        if value.size != steps * feature.width:
            raise InputError(f"{where}: '{key}' has the shape {value.shape}, not {shape}.")
        if not np.all(np.isfinite(value)):
            raise InputError(f"{where}: '{key}' is not finite everywhere.")
        out[key] = value.reshape(shape).astype(feature.dtype)
    return out
