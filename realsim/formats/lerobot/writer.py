"""Episodes as a LeRobot v3.0 data set, one at a time in memory.

Several episodes share a file of each kind. An episode that is encoded is kept beside the data set
until its file is full (`spool`), so that a killed export goes on at the next episode.
"""

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.formats.export_folder import Content, ExportFolder
from realsim.formats.labelled_scene import WrittenScene
from realsim.formats.lerobot import episodes as layout
from realsim.formats.lerobot.episodes import LeRobotSource, check_source
from realsim.formats.lerobot.spool import (
    SPOOL,
    SpooledEpisode,
    forget,
    import_av,
    join,
    spool,
    spooled,
)
from realsim.formats.lerobot.tables import (
    Stats,
    column_stats,
    data_bytes,
    episodes_bytes,
    tasks_bytes,
    together,
)
from realsim.store import atomic

GROUPS = "meta/groups"
"""Rows of the export's own: what is known of each group of episodes."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LeRobotConfig:
    """How the files are filled."""

    episodes_per_file: int = 50
    """Episodes of one Parquet file and one video: of ten seconds each about 20 MB, far below the
    sizes up to which LeRobot itself fills a file."""

    def __post_init__(self) -> None:
        """Check the number.

        Raises:
            InputError: it is not positive.
        """
        if not 1 <= self.episodes_per_file <= 10_000:
            raise InputError(
                f"{self.episodes_per_file} episodes in a file cannot be; 1 to 10000 is accepted."
            )


def write_lerobot(
    source: LeRobotSource,
    folder: ExportFolder,
    config: LeRobotConfig | None = None,
    *,
    progress: Callable[[], None] | None = None,
) -> WrittenScene:
    """Write all episodes of a source.

    Args:
        source: the episodes.
        folder: where to; `finish` is called by whoever made it.
        config: how the files are filled.
        progress: called once an episode.

    Raises:
        InputError: PyAV is not installed, or the source cannot be written.
    """
    config = config or LeRobotConfig()
    import_av()
    check_source(source)
    size, written = config.episodes_per_file, 0
    first_frame = 0
    known = {int(key): row for key, row in folder.rows(GROUPS)}
    for group, first in enumerate(range(0, len(source), size)):
        numbers = range(first, min(first + size, len(source)))
        if group not in known:
            episodes: list[SpooledEpisode] = []
            for k in numbers:
                there = spooled(folder, source, k)
                episodes.append(there or spool(folder, source, k))
                written += 0 if there else episodes[-1].steps
                if progress is not None:
                    progress()
            known[group] = _write_group(folder, source, group, first, first_frame, episodes)
        elif progress is not None:
            for _ in numbers:
                progress()
        first_frame += int(known[group]["frames"])
    _write_meta(folder, source, first_frame)
    notes = [note for row in known.values() for e in row["episodes"] for note in e.get("notes", ())]
    return WrittenScene(
        name=source.name,
        folder=folder.folder,
        frames=first_frame,
        frames_written=written,
        objects=first_frame,
        notes=tuple(dict.fromkeys(notes)),
        counts={
            "episodes": len(source),
            "tasks": len(source.tasks),
            "videos": len(source.cameras) * len(known),
        },
    )


def _write_group(
    folder: ExportFolder,
    source: LeRobotSource,
    group: int,
    first: int,
    first_frame: int,
    episodes: list[SpooledEpisode],
) -> dict[str, Any]:
    """Write the files of a group of episodes, and return what is known of it."""
    place = layout.numbers(group)
    tables: list[dict[str, NDArray[Any]]] = []
    rows: list[dict[str, Any]] = []
    stats: list[Stats] = []
    frame, time_frames = first_frame, 0
    for k, episode in enumerate(episodes, first):
        columns = _whole(source, episode, k, frame)
        stats.append({**episode.pictures, **column_stats(columns)})
        tables.append(columns)
        rows.append(_episode_row(source, episode, k, place, frame, time_frames, stats[-1]))
        frame += episode.steps
        time_frames += episode.steps
    known = {
        "frames": time_frames,
        "stats": together(stats),
        "episodes": [{"episode_index": k, **e.notes} for k, e in enumerate(episodes, first)],
    }
    files: dict[str, Content] = {
        layout.DATA_PATH.format(**place): data_bytes(layout.columns_of(source), tables),
        layout.EPISODES_PATH.format(**place): episodes_bytes(rows),
    }
    spooling = folder.folder / SPOOL
    spooling.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=spooling) as joined:
        for i, key in enumerate(source.cameras):
            path = Path(joined) / f"{i}.mp4"
            join([(e.videos[key], e.steps) for e in episodes], path, source.fps)
            files[layout.VIDEO_PATH.format(video_key=key, **place)] = path
        folder.write_piece(f"episodes {first}", files, {GROUPS: (str(group), known)})
    for k in range(first, first + len(episodes)):
        forget(folder, k)
    return known


def _whole(
    source: LeRobotSource, episode: SpooledEpisode, k: int, first_frame: int
) -> dict[str, NDArray[Any]]:
    """Return an episode's columns with those that every data set has."""
    steps = np.arange(episode.steps, dtype=np.int64)
    return {
        **episode.columns,
        "timestamp": (steps / source.fps).astype(np.float32),
        "frame_index": steps,
        "episode_index": np.full(episode.steps, k, np.int64),
        "index": first_frame + steps,
        "task_index": np.full(episode.steps, list(source.tasks).index(episode.task), np.int64),
    }


def _episode_row(
    source: LeRobotSource,
    episode: SpooledEpisode,
    k: int,
    place: dict[str, int],
    first_frame: int,
    frames_before: int,
    stats: Stats,
) -> dict[str, Any]:
    """Return an episode's row in meta/episodes."""
    row: dict[str, Any] = {
        "episode_index": k,
        "tasks": [episode.task],
        "length": episode.steps,
        **{f"data/{name}": value for name, value in place.items()},
        "dataset_from_index": first_frame,
        "dataset_to_index": first_frame + episode.steps,
    }
    for key in source.cameras:
        row |= {f"videos/{key}/{name}": value for name, value in place.items()}
        row[f"videos/{key}/from_timestamp"] = frames_before / source.fps
        row[f"videos/{key}/to_timestamp"] = (frames_before + episode.steps) / source.fps
    for key, values in stats.items():
        row |= {f"stats/{key}/{name}": value for name, value in values.items()}
    return row | {f"meta/episodes/{name}": value for name, value in place.items()}


def _write_meta(folder: ExportFolder, source: LeRobotSource, frames: int) -> None:
    """Write what is said of all episodes."""
    stats = together(row["stats"] for _, row in folder.rows(GROUPS))
    folder.write_piece(
        "meta",
        {
            layout.INFO: atomic.json_bytes(layout.info(source, len(source), frames), indent=4),
            layout.STATS: atomic.json_bytes(stats, indent=4),
            layout.TASKS: tasks_bytes(source.tasks),
        },
    )
    folder.write_document(layout.NOTES, _note_lines(folder))


def _note_lines(folder: ExportFolder) -> Iterator[str]:
    """Yield what is known of the episodes besides, a line of JSON each."""
    for _, row in folder.rows(GROUPS):
        for episode in row["episodes"]:
            yield atomic.json_bytes(episode, indent=None).decode().strip() + "\n"
