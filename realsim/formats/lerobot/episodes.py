"""What a LeRobot data set is written from, and where its files are.

Episodes come one after the other, from a source.

    meta/info.json stats.json tasks.parquet
    meta/episodes/chunk-000/file-000.parquet   a row an episode: where its steps and videos are
    data/chunk-000/file-000.parquet            a row a step, several episodes
    videos/KEY/chunk-000/file-000.mp4          the same episodes, one after the other
    realsim/episodes.jsonl                     what LeRobot has no place for

Checked against lerobot's own writer and reader (datasets/dataset_writer.py, dataset_metadata.py,
io_utils.py, feature_utils.py; codebase version v3.0).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array32, Rgb, UInt16
from realsim.errors import InputError

DTYPES = ("float32", "int64", "bool")
GIVEN_BY_WRITER = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Columns that every data set has; the writer fills them."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LeRobotFeature:
    """One column of numbers: a row of them at every step."""

    dtype: str
    """'float32', 'int64' or 'bool'."""
    names: tuple[str, ...] = ()
    """Names of its numbers; () = one number without a name of its own."""

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


@dataclass(frozen=True, kw_only=True, slots=True)
class LeRobotCamera:
    """One camera: colours, or depth."""

    size: tuple[int, int]
    """Height and width of its pictures [px]."""
    is_depth: bool = False
    """Whether its pictures are depth (H, W) [m], 0 = nothing, in place of colours (H, W, 3)."""
    info: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """What else is said of it in meta/info.json, as plain JSON values."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class LeRobotEpisode:
    """One episode of S steps."""

    task: str
    """In words."""
    columns: Mapping[str, NDArray[Any]]
    """(S,) or (S, width) of every feature."""
    frames: Iterator[Mapping[str, Rgb | Array32]]
    """The pictures of every camera, step by step; taken once, one at a time."""
    metadata: Mapping[str, bool | int | float | str] = field(
        default_factory=dict[str, "bool | int | float | str"]
    )
    """What is known of it as a whole: columns of meta/episodes, the same of every episode."""
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
    def cameras(self) -> Mapping[str, LeRobotCamera]:
        """The cameras by key, such as observation.images.wrist."""
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
    for key, camera in source.cameras.items():
        height, width = camera.size
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


VERSION = "v3.0"
CHUNK_FILES = 1000
"""Files of a chunk's folder, at most; LeRobot's own."""
DATA_FILE_MB, VIDEO_FILE_MB = 100, 200
"""Sizes up to which LeRobot itself fills files when it adds episodes [MB]; its own."""
INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
NOTES = "realsim/episodes.jsonl"
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH = f"data/{_FILE}.parquet"
VIDEO_PATH = f"videos/{{video_key}}/{_FILE}.mp4"
EPISODES_PATH = f"meta/episodes/{_FILE}.parquet"
CODEC, PIXELS = "h264", "yuv420p"
"""Codec and pixel format of the videos, as FFmpeg names them."""
WRITTEN = {
    "timestamp": LeRobotFeature(dtype="float32"),
    "frame_index": LeRobotFeature(dtype="int64"),
    "episode_index": LeRobotFeature(dtype="int64"),
    "index": LeRobotFeature(dtype="int64"),
    "task_index": LeRobotFeature(dtype="int64"),
}
"""The columns that the writer fills: time since the episode's start [s], number of the step in the
episode and in all, of the episode, of the task."""


def numbers(group: int) -> dict[str, int]:
    """Return chunk_index and file_index of the files of a group of episodes."""
    return {"chunk_index": group // CHUNK_FILES, "file_index": group % CHUNK_FILES}


def columns_of(source: LeRobotSource) -> dict[str, LeRobotFeature]:
    """Return all columns of the data, in the order of the file."""
    return {**source.features, **WRITTEN}


def info(source: LeRobotSource, episodes: int, frames: int) -> dict[str, Any]:
    """Return the content of meta/info.json."""
    return {
        "codebase_version": VERSION,
        "robot_type": source.robot_type,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": len(source.tasks),
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": DATA_FILE_MB,
        "video_files_size_in_mb": VIDEO_FILE_MB,
        "fps": source.fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if source.cameras else None,
        "features": {**_videos(source.cameras, source.fps), **_numbers(columns_of(source))},
    }


def _numbers(features: Mapping[str, LeRobotFeature]) -> dict[str, Any]:
    return {
        key: {"dtype": f.dtype, "shape": [f.width], "names": list(f.names) or None}
        for key, f in features.items()
    }


def _videos(cameras: Mapping[str, LeRobotCamera], fps: int) -> dict[str, Any]:
    """Return the features of the videos; of depth as LeRobot's own reader undoes its codes."""
    out: dict[str, Any] = {}
    for key, camera in cameras.items():
        height, width = camera.size
        channels = 1 if camera.is_depth else 3
        said = {
            "video.height": height,
            "video.width": width,
            "video.codec": DEPTH_CODEC if camera.is_depth else CODEC,
            "video.pix_fmt": DEPTH_PIXELS if camera.is_depth else PIXELS,
            "video.fps": fps,
            "video.channels": channels,
            "has_audio": False,
            "is_depth_map": camera.is_depth,
            "video.is_depth_map": camera.is_depth,
        }
        if camera.is_depth:
            said |= {
                "depth_unit": "m",
                "video.depth_min": DEPTH_MIN_M,
                "video.depth_max": DEPTH_MAX_M,
                "video.shift": DEPTH_SHIFT_M,
                "video.use_log": True,
            }
        out[key] = {
            "dtype": "video",
            "shape": [height, width, channels],
            "names": ["height", "width", "channels"],
            "info": said | dict(camera.info),
        }
    return out


DEPTH_CODEC, DEPTH_PIXELS = "hevc", "gray12le"
DEPTH_MIN_M, DEPTH_MAX_M, DEPTH_SHIFT_M = 0.01, 10.0, 3.5
"""Depth of the lowest and the highest code, and the shift under the logarithm [m]: LeRobot's."""
DEPTH_CODES = 4095
"""The highest code of 12 bits."""


def depth_codes(depth_m: Array32) -> UInt16:
    """Return the codes of depths [m], as LeRobot has them: log(z + shift) in 4096 steps.

    A step is 1.4 mm at 0.7 m. Nothing (0) and all that is nearer than 1 cm is code 0.
    """
    low, high = np.log(DEPTH_MIN_M + DEPTH_SHIFT_M), np.log(DEPTH_MAX_M + DEPTH_SHIFT_M)
    share = (np.log(depth_m + np.float32(DEPTH_SHIFT_M)) - low) / (high - low)
    return np.rint(share * DEPTH_CODES).clip(0, DEPTH_CODES).astype(np.uint16)


def depth_of_codes(codes: UInt16) -> Array32:
    """Return the depths [m] of codes, the inverse of `depth_codes`; code 0 is 0, nothing."""
    low, high = np.log(DEPTH_MIN_M + DEPTH_SHIFT_M), np.log(DEPTH_MAX_M + DEPTH_SHIFT_M)
    depth = np.exp(codes * ((high - low) / DEPTH_CODES) + low) - DEPTH_SHIFT_M
    return np.where(codes == 0, 0.0, depth).astype(np.float32)
