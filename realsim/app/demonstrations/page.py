"""A page to look at demonstrations: some attempts as rows of pictures, out of the videos."""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.export.card import DatasetCard, SceneFacts, card_bytes, options_told
from realsim.arrays import Rgb
from realsim.formats.export_folder import Content
from realsim.formats.labelled_scene import WrittenScene
from realsim.formats.lerobot import episodes as layout
from realsim.formats.lerobot.spool import read_video
from realsim.images import resized
from realsim.pages import Page
from realsim.pages.pictures import Picture

SHOWN = 4
"""Successful attempts, and as many failed ones, that are shown."""
COLUMNS = 8
"""Pictures of a row."""
PICTURE_PX = 200
"""Width of a picture."""
POSTER_PX = 240
"""Width of what a video shows before it is played: its middle, as large as the player."""


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
    features = json.loads((folder / layout.INFO).read_text())["features"]
    cameras = [key for key, f in features.items() if f["dtype"] == "video" and f["shape"][2] == 3]
    succeeded = sum(bool(n["success"]) for n in notes)
    summary = (
        f"{len(notes)} attempts, {succeeded} successful, at {fps} steps per second. Each row shows "
        "one attempt from its beginning to its end; the videos are those of the data set."
    )
    page = Page(title="Demonstrations", about=summary)
    for k in shown_episodes(notes):
        _add_attempt(page, folder, rows[k], notes[k], cameras, fps)
    return {name: page.encode()}


def shown_episodes(notes: Sequence[Mapping[str, Any]]) -> list[int]:
    """Return the episodes that are shown: some that succeeded, some that failed in other ways."""
    good = [k for k, n in enumerate(notes) if n["success"]]
    bad = sorted(
        (k for k, n in enumerate(notes) if not n["success"]), key=lambda k: (_earlier(notes, k), k)
    )
    return [*good[:SHOWN], *bad[:SHOWN]]


def _earlier(notes: Sequence[Mapping[str, Any]], k: int) -> int:
    """Return how many attempts before failed in the same stage."""
    stage = str(notes[k]["failure"]).partition(":")[0]
    return sum(not n["success"] and str(n["failure"]).partition(":")[0] == stage for n in notes[:k])


def _add_attempt(
    page: Page,
    folder: Path,
    row: Mapping[str, Any],
    note: Mapping[str, Any],
    cameras: Sequence[str],
    fps: int,
) -> None:
    """Add one attempt: its pictures and its videos."""
    outcome = "passed all stages" if note["success"] else note["failure"]
    chance = f"; p_hold {note['p_hold']:.2f}" if note.get("p_hold") is not None else ""
    words = f"{outcome}; score {note['score']:.2f}{chance}; {row['length']} steps."
    said = [words, *note["notes"]]
    title = f"Episode {row['episode_index']}: {row['tasks'][0]} (grasp {note['grasp']})"
    page.section(title, " ".join(said))
    times = np.linspace(0, row["length"] - 1, COLUMNS).round().astype(int).tolist()
    strips: list[Rgb] = []
    videos: list[tuple[str, Picture]] = []
    for camera in cameras:
        place = {n: row[f"videos/{camera}/{n}"] for n in ("chunk_index", "file_index")}
        path = layout.VIDEO_PATH.format(video_key=camera, **place)
        begin, end = (row[f"videos/{camera}/{at}_timestamp"] for at in ("from", "to"))
        middle = int(row["length"]) // 2
        seen = _pictures(folder / path, round(begin * fps), {*times, middle})
        strips.append(np.concatenate([resized(seen[k], PICTURE_PX) for k in times], axis=1))
        videos.append((f"{path}#t={begin:g},{end:g}", resized(seen[middle], POSTER_PX)))
    if strips:
        page.picture(np.concatenate(strips), "steps")
    page.videos(videos)


def _pictures(path: Path, first: int, steps: Collection[int]) -> dict[int, Rgb]:
    """Return the pictures (H, W, 3) of some steps of an episode, by step.

    Args:
        path: of the video.
        first: frame that the episode begins with.
        steps: which.
    """
    found = read_video(path, {first + k for k in steps})
    return {k: np.asarray(rgb, np.uint8) for k, (_, rgb) in zip(sorted(steps), found, strict=False)}


# --- The card of a data set of demonstrations ----------------------------------------------------


if TYPE_CHECKING:
    from realsim.app.demonstrations.run import DemonstrationRequest

LOADING = """
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("local/demonstrations", root="FOLDER")
step = dataset[0]  # observation.state, observation.images.front, action, task, ...
"""


def demonstrations_card(
    request: "DemonstrationRequest",
    written: WrittenScene,
    names: dict[int, str],
    successes: int,
    out: Path,
) -> bytes:
    """Return the card as Markdown.

    Args:
        request: what was asked for.
        written: what came of it.
        names: of the objects, by id.
        successes: attempts that passed all stages.
        out: the data set's folder.
    """
    from realsim_sim_bridge.demonstrations.lerobot_episodes import CONVENTIONS

    facts = SceneFacts(
        written=replace(
            written, folder=Path(), counts={**written.counts, "successful episodes": successes}
        ),
        labels="replayed in simulation by realsim: physics of the hand, rendered pictures",
        instances=len(names),
        grasps_tried=written.counts["episodes"],
        grasps_good=successes,
    )
    options = options_told(request, type(request)())
    return card_bytes(
        DatasetCard(
            name=request.name or out.resolve().name,
            format="LeRobot",
            conventions=[("version", "LeRobot v3.0"), ("steps per second", str(request.fps)),
                         *CONVENTIONS],
            scenes=[facts],
            objects=names,
            loading=LOADING,
            command=[("command", "realsim demonstrations"), *options],
            sources=[written.name],
            licence=request.licence,
            models_licence=request.models_licence,
            attribution=request.attribution,
        )
    )  # fmt: skip
