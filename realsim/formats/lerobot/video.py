"""Videos of episodes: encoded one by one, then put one after the other without encoding again.

H.264 by libx264, a key frame every second frame as LeRobot has it, no B-frames, one thread: the
same pictures give the same bytes. Measured on rendered 320 x 240 pictures: 1.6 ms a frame, 45 dB at
0.8 kB; AV1 by libsvtav1 (LeRobot's default) takes 12 ms for 46 dB at the same size.
"""

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError
from realsim.formats.lerobot.layout import PIXELS

Rgb = NDArray[np.uint8]
ENCODER = "libx264"
OPTIONS = {"g": "2", "crf": "23", "bf": "0", "mbtree": "0"}
"""Key frames, quality (x264's own default), and no frames that refer to later ones.

x264's tree of macroblocks, which weighs blocks by what later frames take from them, gives other
bytes from the same pictures in one video of a hundred (64 x 48 px); without it 1200 were alike. Its
use ends at the next key frame: files are 5 % larger without it, and 0.15 dB better."""


def import_av() -> Any:
    """Return PyAV.

    Raises:
        InputError: it is not installed.
    """
    try:
        import av
    except ImportError:
        raise InputError(
            "PyAV is not installed; it writes the videos of LeRobot data sets. Install it with "
            "`uv sync --extra lerobot` or `pip install 'realsim[lerobot]'`."
        ) from None
    return av


class VideoFile:
    """An mp4 file that is filled frame by frame."""

    def __init__(self, path: Path, fps: int, height: int, width: int) -> None:
        """Open it; a file that is there is overwritten."""
        av = import_av()
        self._av, self._size = av, (height, width, 3)
        self.frames = 0
        self._file: Any = av.open(str(path), "w", format="mp4")
        self._stream: Any = self._file.add_stream(ENCODER, rate=fps, options=OPTIONS)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, PIXELS
        # More threads give other bytes from run to run.
        self._stream.codec_context.thread_count = 1
        self._stream.codec_context.time_base = Fraction(1, fps)

    def __enter__(self) -> "VideoFile":
        """Return the file."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close it."""
        if kind is None:
            self._file.mux(self._stream.encode())
        self._file.close()

    def add(self, rgb: Rgb) -> None:
        """Add a picture (H, W, 3).

        Raises:
            InputError: it is of another size.
        """
        if rgb.shape != self._size or rgb.dtype != np.uint8:
            raise InputError(
                f"a picture of shape {rgb.shape}, {rgb.dtype}, does not fit a video of "
                f"{self._size}, uint8."
            )
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
        # Left to the encoder, the conversion gives other bytes in one video of a hundred.
        frame = frame.reformat(format=PIXELS)
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


def read_video(path: Path) -> Iterator[tuple[float, Rgb]]:
    """Yield time [s] and picture (H, W, 3) of every frame of a video."""
    av = import_av()
    with av.open(str(path)) as source:
        for frame in source.decode(source.streams.video[0]):
            yield float(frame.time), frame.to_ndarray(format="rgb24")
