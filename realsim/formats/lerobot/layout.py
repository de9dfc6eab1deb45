"""Where the files of a LeRobot v3.0 data set are, and what meta/info.json says.

    meta/info.json stats.json tasks.parquet
    meta/episodes/chunk-000/file-000.parquet   a row an episode: where its steps and videos are
    data/chunk-000/file-000.parquet            a row a step, several episodes
    videos/KEY/chunk-000/file-000.mp4          the same episodes, one after the other
    realsim/episodes.jsonl                     what LeRobot has no place for

Checked against lerobot's own writer and reader (datasets/dataset_writer.py, dataset_metadata.py,
io_utils.py, feature_utils.py; codebase version v3.0).
"""

from collections.abc import Mapping
from typing import Any

from realsim.formats.lerobot.episodes import LeRobotFeature, LeRobotSource

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
"""Of the videos, as FFmpeg names them."""
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


def _videos(cameras: Mapping[str, tuple[int, int]], fps: int) -> dict[str, Any]:
    return {
        key: {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": height,
                "video.width": width,
                "video.codec": CODEC,
                "video.pix_fmt": PIXELS,
                "video.is_depth_map": False,
                "video.fps": fps,
                "video.channels": 3,
                "has_audio": False,
            },
        }
        for key, (height, width) in cameras.items()
    }
