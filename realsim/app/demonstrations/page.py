"""A page to look at demonstrations: some attempts as rows of pictures, out of the videos."""

import html
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim import __version__
from realsim.formats.export_folder import Content
from realsim.formats.lerobot import episodes as layout
from realsim.formats.lerobot.spool import read_video

Rgb = NDArray[np.uint8]
SHOWN = 4
"""Successful attempts, and as many failed ones, that are shown."""
COLUMNS = 8
"""Pictures of a row."""
PICTURE_PX = 200
"""Width of a picture."""
POSTER_PX = 240
"""Width of what a video shows before it is played: its middle, as large as the player."""
_PAGE = Template("""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Demonstrations</title><style>
body { font: 15px/1.5 system-ui, sans-serif; margin: 2em auto; max-width: 1700px; padding: 0 1em }
img { width: 100%; display: block } video { height: 180px; margin: 0 6px 0 0 }
h2 { margin: 1.6em 0 .2em; font-size: 1.1em } p { margin: .2em 0 .5em; color: #444 }
table { border-collapse: collapse } td, th { padding: .1em .8em .1em 0; text-align: left }
</style></head><body><h1>Demonstrations</h1>
<p>$summary</p>$sections<p>realsim $version</p></body></html>
""")


def page_file(folder: Path, fps: int, name: str) -> Mapping[str, Content]:
    """Return the page of a data set that is written, by its name.

    Args:
        folder: of the data set.
        fps: its steps per second.
        name: of the page's file.
    """
    import pyarrow.parquet as pq

    notes = [json.loads(line) for line in (folder / layout.NOTES).read_text().splitlines()]
    files = sorted((folder / "meta/episodes").glob("*/*.parquet"))
    columns = [c for c in pq.read_schema(files[0]).names if not c.startswith("stats/")]
    rows: list[dict[str, Any]] = [
        row for file in files for row in pq.read_table(file, columns=columns).to_pylist()
    ]
    cameras = [c.split("/")[1] for c in columns if c.endswith("/from_timestamp")]
    sections = "".join(
        _section(folder, rows[k], notes[k], cameras, fps) for k in shown_episodes(notes)
    )
    succeeded = sum(bool(n["success"]) for n in notes)
    summary = (
        f"{len(notes)} attempts, {succeeded} successful, at {fps} steps per second. Each row shows "
        "one attempt from its beginning to its end; the videos are those of the data set."
    )
    page = _PAGE.substitute(summary=html.escape(summary), sections=sections, version=__version__)
    return {name: page.encode("utf-8")}


def shown_episodes(notes: Sequence[Mapping[str, Any]]) -> list[int]:
    """Return the episodes that are shown: some that succeeded, some that failed in other ways."""
    good = [k for k, n in enumerate(notes) if n["success"]]
    bad = sorted(
        (k for k, n in enumerate(notes) if not n["success"]),
        key=lambda k: (_earlier(notes, k), k),
    )
    return [*good[:SHOWN], *bad[:SHOWN]]


def _earlier(notes: Sequence[Mapping[str, Any]], k: int) -> int:
    """Return how many attempts before failed in the same stage."""
    stage = str(notes[k]["failure"]).partition(":")[0]
    return sum(not n["success"] and str(n["failure"]).partition(":")[0] == stage for n in notes[:k])


def _section(
    folder: Path,
    row: Mapping[str, Any],
    note: Mapping[str, Any],
    cameras: Sequence[str],
    fps: int,
) -> str:
    """Return one attempt: its pictures and its videos."""
    outcome = "passed all stages" if note["success"] else note["failure"]
    title = f"Episode {row['episode_index']}: {row['tasks'][0]} (grasp {note['grasp']})"
    said = f"{outcome}; score {note['score']:.2f}; {row['length']} steps."
    if note["notes"]:
        said += " " + " ".join(note["notes"])
    times = np.linspace(0, row["length"] - 1, COLUMNS).round().astype(int)
    strips: list[Rgb] = []
    videos: list[str] = []
    for camera in cameras:
        place = {n: row[f"videos/{camera}/{n}"] for n in ("chunk_index", "file_index")}
        path = layout.VIDEO_PATH.format(video_key=camera, **place)
        begin = row[f"videos/{camera}/from_timestamp"]
        middle = int(row["length"]) // 2
        seen = _pictures(folder / path, round(begin * fps), {*times.tolist(), middle})
        strips.append(
            np.concatenate([_scaled(seen[k], PICTURE_PX) for k in times.tolist()], axis=1)
        )
        span = f"#t={begin:g},{row[f'videos/{camera}/to_timestamp']:g}"
        videos.append(
            f'<video controls muted preload="none" src="{html.escape(path + span)}" '
            f'poster="{_inline(_scaled(seen[middle], POSTER_PX))}"></video>'
        )
    picture = f'<img alt="steps" src="{_inline(np.concatenate(strips))}">' if strips else ""
    return (
        f"<h2>{html.escape(title)}</h2><p>{html.escape(said)}</p>{picture}<p>{''.join(videos)}</p>"
    )


def _pictures(path: Path, first: int, steps: Collection[int]) -> dict[int, Rgb]:
    """Return the pictures (H, W, 3) of some steps of an episode, by step.

    Args:
        path: of the video.
        first: frame that the episode begins with.
        steps: which.
    """
    found: dict[int, Rgb] = {}
    for k, (_, rgb) in enumerate(read_video(path)):
        if k - first in steps:
            found[k - first] = rgb
        if k - first >= max(steps):
            break
    return found


def _scaled(rgb: Rgb, width_px: int) -> Rgb:
    """Return a picture of another width."""
    import cv2

    size = width_px, round(width_px * rgb.shape[0] / rgb.shape[1])
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


def _inline(rgb: Rgb) -> str:
    """Return a picture as an address that holds it."""
    import base64

    import cv2

    quality = [cv2.IMWRITE_JPEG_QUALITY, 85]
    data = cv2.imencode(".jpg", np.ascontiguousarray(rgb[..., ::-1]), quality)[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"
