"""How many frames a core writes: colour and depth at 1280x720, files and checksums included.

Imported by `formats.py`. Every way writes the same frames into an `ExportFolder`, in turn, so that
a busy machine slows all of them. A second is one of CPU, of the process and the kernel for it.
On frames of five sensors ISA-L's level 2 changed sizes by less than 1 %, and level 3 made real
colour and all depth larger. OpenCV's level 1 took twice the time of its default for larger files.
"""

import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from figures import Found
from formats_frames import Picture, real, simulated
from numpy.typing import NDArray

from realsim import images
from realsim.formats.bop.writing import colour_content, depth_content
from realsim.formats.export_folder import Content, ExportFolder

Files = Mapping[str, Content]
Way = Callable[[Picture], Files]
Image = NDArray[Any]
JPEG_QUALITY = 95
ROUNDS, QUICK_ROUNDS = 8, 1


def write_speed(seed: int, quick: bool) -> Found:
    """Return frames per CPU second of the encoders, and their bytes."""
    pictures = list((*simulated(seed, 2), *real()))
    if quick:
        pictures = list({p.kind: p for p in pictures}.values())
    with tempfile.TemporaryDirectory() as home:
        ways = {**_ways(), "copy": _copy(Path(home) / "source", pictures)}
        timed = _timed(ways, pictures, Path(home), QUICK_ROUNDS if quick else ROUNDS)
    found = Found()
    kinds = list(dict.fromkeys(p.kind for p in pictures))
    speeds = {
        way: {k: float(1.0 / np.mean([s for s, _ in timed[way, k]])) for k in kinds} for way in ways
    }
    slowest = {way: min(by_kind.values()) for way, by_kind in speeds.items()}
    found.add("write_frames_per_s", slowest["realsim"], _over(speeds["realsim"]))
    found.add("jpeg_frames_per_s", slowest["jpeg"], _over(speeds["jpeg"]))
    found.add("copy_frames_per_s", slowest["copy"], _over(speeds["copy"]))
    found.rivals["write_frames_per_s"] = _rival(
        slowest, ("opencv default", "opencv 1", "opencv 3", "pillow 6")
    )
    found.rivals["jpeg_frames_per_s"] = _rival(slowest, ("opencv jpeg+3",))
    sizes = {way: {k: _size(timed[way, k]) for k in kinds} for way in ways}
    ratios = {k: sizes["realsim"][k] / sizes["opencv 3"][k] for k in kinds}
    found.add("bytes_over_cv2", max(ratios.values()), _over(ratios))
    others = (f"{w}: {np.mean([s / sizes['opencv 3'][k] for k, s in sizes[w].items()]):.2f}"
              for w in ("opencv default", "opencv 1", "pillow 6", "jpeg"))  # fmt: skip
    found.rivals["bytes_over_cv2"] = "mean of all kinds, " + ", ".join(others)
    found.cases["write_speed"] = {"frames_per_s": speeds, "bytes": sizes}
    return found


def _ways() -> dict[str, Way]:
    import cv2

    level = cv2.IMWRITE_PNG_COMPRESSION

    def pair(png: Callable[[Image], bytes]) -> Way:
        return lambda p: {"rgb.png": png(p.rgb), "depth.png": png(p.depth)}

    def with_jpeg(png: Callable[[Image], bytes]) -> Way:
        return lambda p: {"rgb.jpg": _jpeg(p.rgb), "depth.png": png(p.depth)}

    return {
        "realsim": pair(images.png_bytes),
        "jpeg": with_jpeg(images.png_bytes),
        "opencv 1": pair(lambda i: opencv_png(i, (level, 1))),
        "opencv 3": pair(lambda i: opencv_png(i, (level, 3))),
        "opencv jpeg+3": with_jpeg(lambda i: opencv_png(i, (level, 3))),
        "opencv default": pair(lambda i: opencv_png(i, ())),
        "pillow 6": pair(_pillow),
    }


def _jpeg(rgb: Image) -> bytes:
    """Return a JPEG as `realsim.formats.bop.writing` makes it."""
    import cv2

    done, data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert done
    return data.tobytes()


def _pillow(image: Image) -> bytes:
    import io

    from PIL import Image as pillow

    buffer = io.BytesIO()
    pillow.fromarray(image).save(buffer, "PNG")
    return buffer.getvalue()


def _copy(source: Path, pictures: Sequence[Picture]) -> Way:
    """Return the way of an export whose source already has the format."""
    source.mkdir()
    for k, p in enumerate(pictures):
        (source / f"{k}.rgb.png").write_bytes(images.png_bytes(p.rgb))
        (source / f"{k}.depth.png").write_bytes(images.png_bytes(p.depth))
    places = {id(p): k for k, p in enumerate(pictures)}

    def copied(p: Picture) -> Files:
        k = places[id(p)]
        colour = colour_content(source / f"{k}.rgb.png", "copy", JPEG_QUALITY)
        return {
            "rgb.png": colour.content,
            "depth.png": depth_content(source / f"{k}.depth.png").content,
        }

    return copied


Timed = dict[tuple[str, str], list[tuple[float, int]]]


def _timed(ways: Mapping[str, Way], pictures: Sequence[Picture], home: Path, rounds: int) -> Timed:
    """Return (seconds, bytes) of a frame at 1280x720, by way and kind."""
    timed: Timed = {}
    for way, files_of in ways.items():
        files_of(pictures[0])  # imports, and buffers that stay
        timed |= {(way, p.kind): [] for p in pictures}
    for turn in range(rounds):
        for way, files_of in ways.items():
            if way == "pillow 6" and turn > 0:  # a second a frame
                continue
            folder = ExportFolder.begin(home / "written", {"way": way})
            for k, picture in enumerate(pictures):
                start = time.process_time()
                files = {f"{k:06d}.{name}": data for name, data in files_of(picture).items()}
                folder.write_piece(f"{k:06d}", files)
                seconds = time.process_time() - start
                size = sum((folder.folder / name).stat().st_size for name in files)
                share = picture.share_of_720p
                timed[way, picture.kind].append((seconds / share, round(size / share)))
            shutil.rmtree(home / "written")
    return timed


def _size(rows: Sequence[tuple[float, int]]) -> float:
    return float(np.mean([size for _, size in rows]))


def _over(by_kind: Mapping[str, float]) -> str:
    each = ", ".join(f"{k} {v:.3g}" for k, v in by_kind.items())
    return f"the worst kind of frame; {each} (smaller frames by their pixels)"


def _rival(slowest: Mapping[str, float], ways: Sequence[str]) -> str:
    return ", ".join(f"{way} {slowest[way]:.1f}" for way in ways)


def opencv_png(image: Image, flags: tuple[int, ...]) -> bytes:
    """Return OpenCV's PNG; the channels of RGB are exchanged first, as its callers have to."""
    import cv2

    given = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    done, data = cv2.imencode(".png", given, list(flags))
    assert done
    return data.tobytes()
