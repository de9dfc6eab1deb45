"""Videos of episodes: encoded one by one, then put one after the other without encoding again.

H.264 by libx264, a key frame every second frame as LeRobot has it, no B-frames, one thread: the
same pictures give the same bytes. Measured on rendered 320 x 240 pictures: 1.6 ms a frame, 45 dB at
0.8 kB; AV1 by libsvtav1 (LeRobot's default) takes 12 ms for 46 dB at the same size.
"""

import io
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array32, Rgb
from realsim.errors import InputError
from realsim.formats.export_folder import STATE, ExportFolder
from realsim.formats.lerobot.episodes import (
    DEPTH_PIXELS,
    PIXELS,
    LeRobotEpisode,
    LeRobotSource,
    checked_columns,
    depth_codes,
    depth_of_codes,
)
from realsim.formats.lerobot.tables import PictureStats, Stats
from realsim.interop import import_extra
from realsim.store.arrays_on_disk import is_whole, read_arrays, write_arrays

ENCODER = "libx264"
OPTIONS = {"g": "2", "crf": "23", "bf": "0", "mbtree": "0"}
"""Key frames, quality (x264's own default), and no frames that refer to later ones.

x264's tree of macroblocks, which weighs blocks by what later frames take from them, gives other
bytes from the same pictures in one video of a hundred (64 x 48 px); without it 1200 were alike. Its
use ends at the next key frame: files are 5 % larger without it, and 0.15 dB better."""

DEPTH_ENCODER = "libx265"
DEPTH_OPTIONS = {
    "preset": "ultrafast",
    "x265-params": "lossless=1:keyint=2:bframes=0:pools=none:frame-threads=1:log-level=none",
}
"""Nothing is lost but by the codes, and one thread, so that the bytes repeat."""


def import_av() -> Any:
    """Return PyAV.

    Raises:
        MissingLibraryError: it, or pyarrow, is not installed.
    """
    import_extra("pyarrow", "lerobot", "a LeRobot data set")
    return import_extra("av", "lerobot", "a LeRobot data set")


class VideoFile:
    """An mp4 file that is filled frame by frame."""

    def __init__(
        self, file: Path | io.BytesIO, fps: int, size: tuple[int, int], *, depth: bool = False
    ) -> None:
        """Open it; a file that is there is overwritten.

        Args:
            file: where to.
            fps: frames per second.
            size: height and width [px].
            depth: whether the pictures are depth, kept without a loss but that of its codes.
        """
        av = import_av()
        self._av, self._depth = av, depth
        self._shape = size if depth else (*size, 3)
        self.frames = 0
        # One for all frames: each of its own would prepare its tables anew, 2 ms a frame.
        self._reformatter = av.video.reformatter.VideoReformatter()
        target = file if isinstance(file, io.BytesIO) else str(file)
        self._file: Any = av.open(target, "w", format="mp4")
        encoder, options = (DEPTH_ENCODER, DEPTH_OPTIONS) if depth else (ENCODER, OPTIONS)
        self._stream: Any = self._file.add_stream(encoder, rate=fps, options=options)
        self._stream.height, self._stream.width = size
        self._stream.pix_fmt = DEPTH_PIXELS if depth else PIXELS
        # More threads give other bytes from run to run; episodes are what is done side by side.
        self._stream.codec_context.thread_count = 1
        self._stream.codec_context.time_base = Fraction(1, fps)

    def __enter__(self) -> "VideoFile":
        """Return the file."""
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        """Close it."""
        if kind is None:
            self._file.mux(self._stream.encode())
        self._file.close()

    def add(self, picture: Rgb | Array32) -> None:
        """Add a picture: colours (H, W, 3), or depth (H, W) [m].

        Raises:
            InputError: it is of another size or kind.
        """
        kind = np.float32 if self._depth else np.uint8
        if picture.shape != self._shape or picture.dtype != kind:
            raise InputError(
                f"a picture of shape {picture.shape}, {picture.dtype}, does not fit a video of "
                f"{self._shape}, {np.dtype(kind)}."
            )
        if self._depth:
            codes = depth_codes(np.asarray(picture, np.float32))
            frame = self._av.VideoFrame.from_ndarray(codes, format=DEPTH_PIXELS)
        else:
            colours = np.ascontiguousarray(picture)
            frame = self._av.VideoFrame.from_ndarray(colours, format="rgb24")
            # Left to the encoder, the conversion gives other bytes in one video of a hundred.
            frame = self._reformatter.reformat(frame, format=PIXELS, threads=1)
        frame.pts, frame.time_base = self.frames, self._stream.codec_context.time_base
        self._file.mux(self._stream.encode(frame))
        self.frames += 1


def join(parts: Sequence[tuple[Path, int]], path: Path, fps: int) -> None:
    """Put videos of alike settings one after the other.

    Args:
        parts: files and the numbers of their frames.
        path: the new file.
        fps: of all.
    """
    av = import_av()
    with av.open(str(path), "w", format="mp4") as out:
        stream: Any = None
        before = 0
        for part, frames in parts:
            with av.open(str(part)) as source:
                given = source.streams.video[0]
                if stream is None:
                    stream = out.add_stream_from_template(given)
                    stream.time_base = given.time_base
                shift = Fraction(before, fps) / given.time_base
                for packet in source.demux(given):
                    if packet.dts is None:  # the end of the stream
                        continue
                    packet.pts += int(shift)
                    packet.dts += int(shift)
                    packet.stream = stream
                    out.mux(packet)
            before += frames


def read_video(
    path: Path, wanted: Collection[int] | None = None
) -> Iterator[tuple[float, Rgb | Array32]]:
    """Yield time [s] and picture of frames of a video: (H, W, 3), or depth (H, W) [m].

    Args:
        path: of the video.
        wanted: numbers of the frames; None = all. Others are not made pictures of, which is most of
            the work.
    """
    av = import_av()
    with av.open(str(path)) as source:
        for k, frame in enumerate(source.decode(source.streams.video[0])):
            if wanted is not None and k not in wanted:
                continue
            if frame.format.name == DEPTH_PIXELS:
                yield float(frame.time), depth_of_codes(frame.to_ndarray(format=DEPTH_PIXELS))
            else:
                yield float(frame.time), frame.to_ndarray(format="rgb24")


SPOOL = f"{STATE}/episodes"


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class EncodedEpisode:
    """An episode as it is written."""

    columns: Mapping[str, NDArray[Any]]
    """(S,) or (S, width) of the source's features."""
    videos: Mapping[str, bytes]
    """mp4 files, by camera."""
    said: Mapping[str, Any]
    """Statistics of the pictures, task, notes and metadata, as plain JSON values."""


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
    metadata: Mapping[str, Any]

    @property
    def steps(self) -> int:
        """The number of its steps."""
        return len(next(iter(self.columns.values())))


def encoded(source: LeRobotSource, k: int) -> EncodedEpisode:
    """Return an episode of a source, its videos encoded; pure, so that any process may do it.

    Raises:
        InputError: it does not fit what the source says of its episodes.
    """
    episode = source.episode(k)
    columns = checked_columns(source, k, episode)
    videos, pictures = _encode(source, k, episode, len(next(iter(columns.values()))))
    said = {
        "pictures": pictures,
        "task": episode.task,
        "notes": dict(episode.notes),
        "metadata": dict(episode.metadata),
    }
    return EncodedEpisode(columns=columns, videos=videos, said=said)


def is_spooled(folder: ExportFolder, k: int) -> bool:
    """Return whether an episode is there, and whole."""
    return is_whole(_place(folder, k) / "episode.npz")


def spooled(folder: ExportFolder, source: LeRobotSource, k: int) -> SpooledEpisode:
    """Return an episode that is there."""
    place = _place(folder, k)
    columns, said = read_arrays(place / "episode.npz")
    return SpooledEpisode(
        columns={key: columns[key] for key in source.features},
        videos={key: place / f"video{i}.mp4" for i, key in enumerate(source.cameras)},
        **said,
    )


def spool(folder: ExportFolder, k: int, episode: EncodedEpisode) -> None:
    """Keep an episode until its file is full."""
    place = _place(folder, k)
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    for i, video in enumerate(episode.videos.values()):
        (place / f"video{i}.mp4").write_bytes(video)
    # Last: it says that the episode is whole.
    write_arrays(place / "episode.npz", dict(episode.columns), dict(episode.said))


def forget(folder: ExportFolder, k: int) -> None:
    """Take away an episode whose file is written."""
    shutil.rmtree(_place(folder, k), ignore_errors=True)


def _encode(
    source: LeRobotSource, k: int, episode: LeRobotEpisode, steps: int
) -> tuple[dict[str, bytes], Stats]:
    """Return the videos and the statistics of their pictures."""
    if not source.cameras:
        return {}, {}
    stats = {key: PictureStats(depth=c.is_depth) for key, c in source.cameras.items()}
    files = {key: io.BytesIO() for key in source.cameras}
    seen = 0
    with ExitStack() as stack:
        videos = {
            key: stack.enter_context(
                VideoFile(files[key], source.fps, camera.size, depth=camera.is_depth)
            )
            for key, camera in source.cameras.items()
        }
        for frame in episode.frames:
            seen += 1
            for key, video in videos.items():
                video.add(frame[key])
                stats[key].add(frame[key])
    if seen != steps:
        raise InputError(f"episode {k} of '{source.name}' has {seen} pictures for {steps} steps.")
    return {key: f.getvalue() for key, f in files.items()}, {
        k: s.result() for k, s in stats.items()
    }


def _place(folder: ExportFolder, k: int) -> Path:
    return folder.folder / SPOOL / f"{k:06d}"
