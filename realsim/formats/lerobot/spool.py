"""Episodes that are finished while their file is not: what a killed export keeps.

    OUT/.export/episodes/000012/video0.mp4 ...   a video a camera
    OUT/.export/episodes/000012/episode.npz      columns, statistics and notes; written last

An episode without its last file is begun anew.
"""

import shutil
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.formats.export_folder import STATE, ExportFolder
from realsim.formats.lerobot.episodes import LeRobotEpisode, LeRobotSource, checked_columns
from realsim.formats.lerobot.statistics import PictureStats, Stats
from realsim.formats.lerobot.video import VideoFile
from realsim.store.arrays_on_disk import is_whole, read_arrays, write_arrays

SPOOL = f"{STATE}/episodes"


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class SpooledEpisode:
    """An episode on the disk."""

    columns: Mapping[str, NDArray[Any]]
    """(S,) or (S, width) of the source's features."""
    videos: Mapping[str, Path]
    """By camera."""
    pictures: Stats
    """Statistics of the pictures, by camera."""
    task: str
    notes: Mapping[str, Any]

    @property
    def steps(self) -> int:
        """The number of its steps."""
        return len(next(iter(self.columns.values())))


def spooled(folder: ExportFolder, source: LeRobotSource, k: int) -> SpooledEpisode | None:
    """Return an episode that is there; None = it is not, or not whole."""
    place = _place(folder, k)
    if not is_whole(place / "episode.npz"):
        return None
    columns, said = read_arrays(place / "episode.npz")
    return SpooledEpisode(
        columns={key: columns[key] for key in source.features},
        videos={key: place / f"video{i}.mp4" for i, key in enumerate(source.cameras)},
        pictures=said["pictures"],
        task=said["task"],
        notes=said["notes"],
    )


def spool(folder: ExportFolder, source: LeRobotSource, k: int) -> SpooledEpisode:
    """Take an episode from its source, encode its videos and return it.

    Raises:
        InputError: it does not fit what the source says of its episodes.
    """
    place = _place(folder, k)
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    episode = source.episode(k)
    columns = checked_columns(source, k, episode)
    steps = len(next(iter(columns.values())))
    pictures = _encode(place, source, k, episode, steps)
    write_arrays(
        place / "episode.npz",
        columns,
        {"pictures": pictures, "task": episode.task, "notes": dict(episode.notes)},
    )
    done = spooled(folder, source, k)
    assert done is not None, "it has just been written"
    return done


def forget(folder: ExportFolder, k: int) -> None:
    """Take away an episode whose file is written."""
    shutil.rmtree(_place(folder, k), ignore_errors=True)


def _encode(
    place: Path, source: LeRobotSource, k: int, episode: LeRobotEpisode, steps: int
) -> Stats:
    """Write the videos and return the statistics of their pictures."""
    if not source.cameras:
        return {}
    stats = {key: PictureStats() for key in source.cameras}
    seen = 0
    with ExitStack() as stack:
        videos = {
            key: stack.enter_context(VideoFile(place / f"video{i}.mp4", source.fps, *size))
            for i, (key, size) in enumerate(source.cameras.items())
        }
        for frame in episode.frames:
            seen += 1
            for key, video in videos.items():
                video.add(frame[key])
                stats[key].add(frame[key])
    if seen != steps:
        raise InputError(f"episode {k} of '{source.name}' has {seen} pictures for {steps} steps.")
    return {key: s.result() for key, s in stats.items()}


def _place(folder: ExportFolder, k: int) -> Path:
    return folder.folder / SPOOL / f"{k:06d}"
