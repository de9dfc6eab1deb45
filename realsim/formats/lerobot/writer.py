"""Episodes as a LeRobot v3.0 data set, one at a time in memory.

Several episodes share a file of each kind. An episode that is encoded is kept beside the data set
until its file is full (`spool`), so that a killed export goes on at the next episode.
"""

import tempfile
from collections.abc import Callable, Iterator, Sequence
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
    EncodedEpisode,
    SpooledEpisode,
    encoded,
    forget,
    import_av,
    is_spooled,
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
MOST_LISTED = 6
"""Episodes that a note names; of more it says how many."""

Take = Callable[[int, EncodedEpisode], None]


def write_lerobot(
    source: LeRobotSource,
    folder: ExportFolder,
    *,
    episodes_per_file: int = 50,
    progress: Callable[[], None] | None = None,
    encode: Callable[[Sequence[int], Take], None] | None = None,
) -> WrittenScene:
    """Write all episodes of a source.

    Args:
        source: the episodes.
        folder: where to; `finish` is called by whoever made it.
        episodes_per_file: of one Parquet file and one video: 50 of ten seconds each make about
            20 MB, far below the sizes up to which LeRobot itself fills a file.
        progress: called once an episode.
        encode: given the numbers of the episodes that are missing, hands each on, encoded
            (`spool.encoded`), in any order: the place for other processes. None = one by one.

    Raises:
        InputError: PyAV is not installed, a file cannot have so many episodes, or the source
            cannot be written.
    """
    if not 1 <= episodes_per_file <= 10_000:
        raise InputError(
            f"{episodes_per_file} episodes in a file cannot be; 1 to 10000 is accepted."
        )
    import_av()
    check_source(source)
    writer = _Writer(source, folder, episodes_per_file, progress or _silent)
    missing = writer.begin()
    if encode is None:
        for k in missing:
            writer.take(k, encoded(source, k))
    else:
        encode(missing, writer.take)
    return writer.finish()


def _silent() -> None:
    """Tell nobody."""


class _Writer:
    """Puts episodes into files as they come."""

    def __init__(
        self,
        source: LeRobotSource,
        folder: ExportFolder,
        episodes_per_file: int,
        progress: Callable[[], None],
    ) -> None:
        self._source, self._folder, self._progress = source, folder, progress
        self._size = episodes_per_file
        self._known = {int(key): row for key, row in folder.rows(GROUPS)}
        self._frames = self._written = 0

    def _numbers(self, group: int) -> range:
        """Return the episodes of a group."""
        first = group * self._size
        return range(first, min(first + self._size, len(self._source)))

    def begin(self) -> list[int]:
        """Return the episodes that are not there; write the files that only wait for theirs."""
        count = -(-len(self._source) // self._size)
        of = [k for g in range(count) if g not in self._known for k in self._numbers(g)]
        missing = [k for k in of if not is_spooled(self._folder, k)]
        for _ in range(len(self._source) - len(missing)):
            self._progress()
        self._fill()
        return missing

    def take(self, k: int, episode: EncodedEpisode) -> None:
        """Keep an episode, and write its file if it is full now."""
        spool(self._folder, k, episode)
        self._written += len(next(iter(episode.columns.values())))
        self._progress()
        self._fill()

    def _fill(self) -> None:
        """Write the files whose episodes are there, in their order."""
        frames, group = 0, 0
        while group * self._size < len(self._source):
            numbers = self._numbers(group)
            if group not in self._known:
                if not all(is_spooled(self._folder, k) for k in numbers):
                    return
                episodes = [spooled(self._folder, self._source, k) for k in numbers]
                self._known[group] = _write_group(
                    self._folder, self._source, group, numbers[0], frames, episodes
                )
            frames, group = frames + int(self._known[group]["frames"]), group + 1
        self._frames = frames

    def finish(self) -> WrittenScene:
        """Write what is said of all episodes."""
        _write_meta(self._folder, self._source, self._frames)
        rows = self._known.values()
        told: dict[str, list[str]] = {}
        for episode in (e for row in rows for e in row["episodes"]):
            for note in episode.get("notes", ()):
                told.setdefault(note, []).append(str(episode["episode_index"]))
        return WrittenScene(
            name=self._source.name,
            folder=self._folder.folder,
            frames=self._frames,
            frames_written=self._written,
            objects=self._frames,
            notes=tuple(f"episode {_listed(of)}: {note}" for note, of in told.items()),
            counts={
                "episodes": len(self._source),
                "tasks": len(self._source.tasks),
                "videos": len(self._source.cameras) * len(self._known),
            },
        )


def _listed(episodes: Sequence[str]) -> str:
    """Return the first numbers of episodes, and how many more there are."""
    rest = len(episodes) - MOST_LISTED
    return ", ".join(episodes[:MOST_LISTED]) + (f" and {rest} more" if rest > 0 else "")


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
    with (
        atomic.storing(folder.folder, f"the videos of episodes {first} and further"),
        tempfile.TemporaryDirectory(dir=spooling) as joined,
    ):
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
        **episode.metadata,
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
