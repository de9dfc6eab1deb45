"""Cameras, boards and images as `realsim calibrate --cameras` is given them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from realsim.app.calibrate.folder import target_of
from realsim.errors import InputError
from realsim_calibration.cameras.faults import require_distinct
from realsim_calibration.cameras.rig import Mount, Place, RigBoard, RigCamera
from realsim_calibration.inputs.image_files import list_images
from realsim_calibration.inputs.pairing import pair, running_numbers
from realsim_calibration.inputs.raw_poses import RawPoses

POSE_SUFFIXES = {".csv", ".txt", ".json", ".yaml", ".yml", ".npy", ".npz", ".tum"}
USAGE = (
    "--cameras names every camera and where it is: --cameras wrist=hand,left=fixed. Its images lie "
    "in the folder of its name."
)
BOARD_OPTIONS = {"table": "board", "held": "held_board", "moved": "moved_board"}
PLACE_OF: dict[str, Place] = {"table": "table", "held": "hand", "moved": "free"}


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Frames:
    """The images of all cameras, instant by instant."""

    instants: tuple[str, ...]
    """Names of the instants."""
    images: dict[str, dict[int, Path]]
    """Camera's name -> instant -> image."""
    rows: dict[int, int]
    """Row of the poses at an instant; empty where there are none."""
    left_out: tuple[str, ...] = ()
    """Sentences on images that have no pose, or one of NaN."""


def cameras_of(text: str) -> tuple[RigCamera, ...]:
    """Return the cameras of "wrist=hand,left=fixed".

    Raises:
        InputError: another form, or a name twice.
    """
    found: list[RigCamera] = []
    for part in text.split(","):
        name, _, mount = (p.strip() for p in part.partition("="))
        if not name or mount not in get_args(Mount):
            raise InputError(
                f"--cameras has '{part.strip()}'; NAME=hand or NAME=fixed is expected. {USAGE}"
            )
        if "/" in name or name.startswith("."):
            raise InputError(f"--cameras: '{name}' is no name of a folder inside SOURCE.")
        found.append(RigCamera(name=name, mount="hand" if mount == "hand" else "fixed"))
    names = [c.name for c in found]
    twice = [n for n in names if names.count(n) > 1]
    if twice:
        raise InputError(f"--cameras names '{twice[0]}' twice; every camera has its own folder.")
    return tuple(found)


def boards_of(options: dict[str, Any], *, needed: bool = True) -> tuple[RigBoard, ...]:
    """Return the boards that were given: on the table, in the hand, moved by hand.

    Raises:
        InputError: none, or two that cannot be told apart.
    """
    boards = tuple(
        RigBoard(name=name, target=target_of(options[option]), place=PLACE_OF[name])
        for name, option in BOARD_OPTIONS.items()
        if options.get(option)
    )
    if not boards and needed:
        raise InputError(
            "which board the cameras see was not said: --board for one on the table, --held-board "
            "for one that the arm carries, --moved-board for one that a person moves."
        )
    require_distinct(boards)
    return boards


def with_intrinsics(cameras: tuple[RigCamera, ...], folder: Path | None) -> tuple[RigCamera, ...]:
    """Return the cameras with the intrinsics of a folder's files NAME.*.

    Raises:
        InputError: no folder, or no file of any camera.
    """
    from realsim_calibration.lens.camera_files import read_camera

    if folder is None:
        return cameras
    if not folder.is_dir():
        raise InputError(
            f"--intrinsics {folder}: with --cameras a folder is expected that holds a file of "
            f"every camera whose intrinsics are known, such as {cameras[0].name}.yaml."
        )
    files = {p.stem: p for p in sorted(folder.iterdir()) if p.is_file()}
    if not any(c.name in files for c in cameras):
        names = ", ".join(f"{c.name}.yaml" for c in cameras)
        raise InputError(f"--intrinsics {folder} holds none of {names} (or .json).")
    return tuple(
        replace(c, intrinsics0=read_camera(files[c.name])) if c.name in files else c
        for c in cameras
    )


def pose_file_of(source: Path, given: Path | None, names: Sequence[str]) -> Path | None:
    """Return the file of the arm's poses, None where there is none."""
    if given is not None:
        inside = source / given
        return inside if not given.exists() and inside.exists() else given
    found = [
        p for p in sorted(source.iterdir())
        if p.is_file() and p.suffix.lower() in POSE_SUFFIXES and p.stem not in names
    ]  # fmt: skip
    if len(found) > 1:
        raise InputError(
            f"'{source}' holds {', '.join(p.name for p in found)}: which one has the poses of the "
            "arm? Give --poses."
        )
    return found[0] if found else None


def frames_of(source: Path, cameras: Sequence[RigCamera], raw: RawPoses | None) -> Frames:
    """Return which images belong together, and to which pose.

    Raises:
        InputError: a folder is missing, or names and counts do not tell.
    """
    images: dict[str, list[Path]] = {}
    for camera in cameras:
        folder = source / camera.name
        if not folder.is_dir():
            there = ", ".join(sorted(p.name for p in source.iterdir() if p.is_dir())) or "none"
            raise InputError(
                f"camera '{camera.name}' has no folder '{folder}'; folders there: {there}. {USAGE}"
            )
        images[camera.name] = list(list_images(folder).images)
    keys = {name: _keys(paths) for name, paths in images.items()}
    if raw is not None:
        return _by_poses(images, keys, raw)
    order = sorted({k for own in keys.values() for k in own})
    _require_shared(keys)
    place = {k: n for n, k in enumerate(order)}
    return Frames(
        instants=tuple(order), rows={},
        images={name: {place[k]: p for k, p in zip(keys[name], paths, strict=True)}
                for name, paths in images.items()},
    )  # fmt: skip


def _keys(paths: Sequence[Path]) -> list[str]:
    """Return what the images of an instant have in common: their number, else their name."""
    stems = [p.stem for p in paths]
    numbers = running_numbers(stems)
    return stems if numbers is None else [f"{n:06d}" for n in numbers]


def _require_shared(keys: dict[str, list[str]]) -> None:
    """Raise if a camera has no image of an instant that another one has.

    Raises:
        InputError: shows the names of both.
    """
    if len(keys) < 2:
        return
    for name, own in keys.items():
        others = {k for other, ks in keys.items() if other != name for k in ks}
        if not set(own) & others:
            shown = ", ".join(own[:3])
            theirs = ", ".join(sorted(others)[:3])
            raise InputError(
                f"camera '{name}' has {len(own)} images ({shown}, ...) and none has the name or "
                f"number of another camera's ({theirs}, ...): which were taken at the same "
                "instant? Give images of one instant the same name in every folder."
            )


def _by_poses(images: dict[str, list[Path]], keys: dict[str, list[str]], raw: RawPoses) -> Frames:
    """Return the frames whose instants are the rows of the poses."""
    found: dict[str, dict[int, Path]] = {}
    row_of: dict[str, int] = {}
    failed: dict[str, InputError] = {}
    for name, paths in sorted(images.items(), key=lambda item: -len(item[1])):
        try:
            pairs = pair([p.name for p in paths], raw.labels, raw.stems, raw.where).pairs
        except InputError as error:
            failed[name] = error
            continue
        found[name] = {row: paths[k] for k, row in pairs}
        row_of |= {keys[name][k]: row for k, row in pairs}
    for name, error in failed.items():
        # Poses name one camera's images: the others' follow by the number that they share.
        shared = {row_of[k]: p for k, p in zip(keys[name], images[name], strict=True)
                  if k in row_of}  # fmt: skip
        if not shared:
            raise InputError(f"camera '{name}': {error}") from error
        found[name] = shared
    measured = raw.measured
    rows = sorted({r for own in found.values() for r in own if measured[r]})
    place = {r: n for n, r in enumerate(rows)}
    return Frames(
        instants=tuple(raw.labels[r] or raw.stems[r] or raw.where[r] for r in rows),
        rows={n: r for r, n in place.items()},
        images={
            name: {place[r]: p for r, p in own.items() if r in place}
            for name, own in found.items()
        },
        left_out=tuple(_left_out(images, found, raw)),
    )  # fmt: skip


def _left_out(
    images: dict[str, list[Path]], found: dict[str, dict[int, Path]], raw: RawPoses
) -> Iterator[str]:
    """Say which images of a camera no instant has."""
    for name, paths in images.items():
        own = found[name]
        without = [p.name for p in paths if p not in set(own.values())]
        unread = [f"{p.name} ({raw.where[r]})" for r, p in own.items() if not raw.measured[r]]
        for what, which in (("without a", without), ("with a NaN or infinite", unread)):
            if which:
                few = ", ".join(which[:5]) + (", ..." if len(which) > 5 else "")
                yield (
                    f"camera '{name}': images {what} pose are left out: {len(which)} of "
                    f"{len(paths)} ({few})."
                )
