"""A recording as a `FrameSource`: checked when it is opened, then read once, frame by frame."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import UInt16
from realsim.errors import InputError
from realsim.formats.bags import cameras, joints, pixels
from realsim.formats.bags import cameras as rs
from realsim.formats.bags.arm import ArmAtFrames, arm_at
from realsim.formats.bags.joints import UR_JOINTS
from realsim.formats.bags.pixels import counts_of, unit_of
from realsim.formats.bags.recording import Recording
from realsim.formats.bags.scan import ImageTimes, Messages, Scan, StoredImages, scan
from realsim.formats.bags.topics import BagChoice, Topics, choose
from realsim.formats.bags.wire import NS_PER_S, ImageMessage, MessageError
from realsim.formats.frame_source import SourceFrame
from realsim.records import CameraIntrinsics

CHOICE_NAMES = tuple(f.name for f in fields(BagChoice))
UNIT_SAMPLES = 5
"""Depth images looked at to tell whether the unit can be right."""
NAMED_IN_NOTES = 5
"""Frames named in a note; `extra` has the times of all."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BagSource:
    """One camera of a recording; made by `open_bag`."""

    path: Path
    """The file or folder."""
    name: str
    """What the session is to be called."""
    intrinsics: CameraIntrinsics
    """The colour camera."""
    depth_unit_m: float | None
    """Metres per count of depth; None where colour alone is imported."""
    notes: tuple[str, ...]
    """What was left out, what was assumed and why."""
    extra: dict[str, Any]
    """Topics, clock and counts, as plain JSON values."""
    colour: StoredImages
    """Where the colour images of the frames are."""
    depth: StoredImages | None
    """Where their depth images are."""
    reprojection: cameras.Reprojection | None
    """How depth gets onto the colour pixels; None where it is there."""
    arm: ArmAtFrames
    """Where the arm was at each frame."""

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.colour.stamp_ns)

    def frames(self, start: int = 0) -> Iterator[SourceFrame]:
        """Yield the frames from number `start` on, in the order of time.

        Raises:
            InputError: a frame cannot be read; the message names it.
        """
        streams = [self.colour] if self.depth is None else [self.colour, self.depth]
        with Recording(self.path) as recording:
            for n, messages in Messages(recording, streams).read(start):
                yield self._frame(n, messages)

    def _frame(self, n: int, messages: list[ImageMessage]) -> SourceFrame:
        seconds = int(self.colour.stamp_ns[n]) / NS_PER_S
        name = f"{self.colour.topic} at {seconds:.6f} s"
        rgb = pixels.rgb_of(messages[0], self.colour.compressed, name)
        camera = self.intrinsics
        _check_size(rgb, (camera.height, camera.width), name)
        return SourceFrame(
            name=name,
            time_s=seconds,
            rgb=rgb,
            depth_counts=None if self.depth is None else self._depth(n, messages[1]),
            joints=self.arm.row(self.arm.joints, n),
            T_base_ee=self.arm.row(self.arm.Ts_base_ee, n),
            T_world_cam=self.arm.row(self.arm.Ts_world_cam, n),
        )

    def _depth(self, n: int, message: ImageMessage) -> UInt16:
        depth, unit = self.depth, self.depth_unit_m
        assert depth is not None and unit is not None
        name = f"{depth.topic} at {int(depth.stamp_ns[n]) / NS_PER_S:.6f} s"
        counts = counts_of(pixels.depth_of(message, depth.compressed, name), unit)
        r = self.reprojection
        camera = self.intrinsics if r is None else r.depth_camera
        _check_size(counts, (camera.height, camera.width), name)
        if r is None:
            return counts
        from realsim.formats.bags.reproject import depth_in_colour  # numba: only where needed

        return depth_in_colour(counts, r.depth_camera, self.intrinsics, r.T_colour_depth, unit)


def _check_size(image: NDArray[Any], size: tuple[int, int], name: str) -> None:
    if image.shape[:2] != size:
        raise InputError(
            f"{name}: the image is {image.shape[1]}x{image.shape[0]}, the ones before it were "
            f"{size[1]}x{size[0]}. A session has one size: cut the recording where it changes."
        )


def open_bag(path: Path | str, choice: BagChoice | None = None) -> BagSource:
    """Open a recording, join what is in it, and say what was assumed.

    ROS1 .bag, ROS2 folders, .db3 and .mcap files, and librealsense's own .bag and .db3 are read.
    The file is read twice: here for the times alone, then by `frames` for the images.

    Args:
        path: the file or folder.
        choice: what to use where the recording leaves a choice.

    Raises:
        InputError: no such recording, nothing usable in it, or more than one reading of it; the
            message has what was found and the choices.
    """
    try:
        return _opened(Path(path), choice or BagChoice())
    except MessageError as error:
        raise InputError(f"{path}: {error}. Copy the file again, or record again.") from error


def _opened(path: Path, choice: BagChoice) -> BagSource:
    """Return the source; a damaged message is not yet named with its file."""
    with Recording(path) as recording:
        topics = choose(recording, choice)
        camera = cameras.colour_camera(recording, topics, choice)
        found = scan(recording, topics, choice)
        notes = [*recording.notes, *topics.notes, *found.notes]
        colour, depth, left_out = _joined(recording, found, choice, notes)
        arm = arm_at(colour.stamp_ns, found, topics, choice)
        notes += arm.notes
        if choice.only_still:
            colour, depth, arm = _still(colour, depth, arm, choice, left_out)
        unit: float | None = None
        reprojection: cameras.Reprojection | None = None
        if depth is not None and topics.depth is not None:
            reprojection, note = cameras.reprojection(
                recording, topics, topics.depth, camera, found.tree, choice
            )
            unit, unit_note = _unit(recording, depth, topics, found, choice)
            notes += [note, unit_note]
        extra = _extra(recording, topics, found, choice, left_out)
    return BagSource(
        path=path,
        name=path.stem or path.name,
        intrinsics=camera,
        depth_unit_m=unit,
        notes=tuple(notes),
        extra=extra,
        colour=colour,
        depth=depth,
        reprojection=reprojection,
        arm=arm,
    )


def _joined(
    recording: Recording, found: Scan, choice: BagChoice, notes: list[str]
) -> tuple[StoredImages, StoredImages | None, dict[str, list[float]]]:
    """Return the images that make frames, and the times of those that do not.

    Raises:
        InputError: no frame is left.
    """
    colour, depth = found.colour, found.depth
    if not len(colour.stamp_ns):
        raise InputError(f"{colour.topic.name}: none of the images has a time stamp.")
    if depth is None:
        return StoredImages.of(colour), None, {}
    if not len(depth.stamp_ns):
        raise InputError(
            f"{depth.topic.name}: none of the images has a time stamp; import colour alone "
            "(without_depth), or join by the time of recording (clock=receive)."
        )
    _check_domains(colour, depth)
    names = (colour.topic.name, depth.topic.name)
    joints.check_overlap(names[0], colour.stamp_ns, names[1], depth.stamp_ns, found.clock)
    gap = choice.max_pair_gap_s or _pair_gap_s(recording, colour, depth)
    pairs = joints.pairs(colour.stamp_ns, depth.stamp_ns, gap)
    if not len(pairs):
        near = joints.nearest(depth.stamp_ns, colour.stamp_ns)
        least = float(np.abs(depth.stamp_ns[near] - colour.stamp_ns).min()) / NS_PER_S
        raise InputError(
            f"none of the {len(colour.stamp_ns)} images of {names[0]} has one of the "
            f"{len(depth.stamp_ns)} of {names[1]} within {gap * 1e3:.1f} ms (half a frame period); "
            f"the nearest is {least * 1e3:.1f} ms away. If nothing moved meanwhile, allow that "
            f"(max_pair_gap_s={np.ceil(least * 100) / 100:g}), or import colour alone "
            "(without_depth)."
        )
    left_out: dict[str, list[float]] = {}
    for times, kept, other in ((colour, pairs[:, 0], "depth"), (depth, pairs[:, 1], "colour")):
        lost = np.delete(times.stamp_ns, kept) / NS_PER_S
        if len(lost):
            left_out[times.topic.name] = [round(float(t), 6) for t in lost]
            first = ", ".join(f"{t:.3f}" for t in lost[:NAMED_IN_NOTES])
            more = f" and {len(lost) - NAMED_IN_NOTES} more" if len(lost) > NAMED_IN_NOTES else ""
            notes.append(
                f"{len(lost)} of {len(times.stamp_ns)} images of {times.topic.name} have no "
                f"{other} within {gap * 1e3:.1f} ms and were left out: at {first}{more} s."
            )
    return (StoredImages.of(colour, pairs[:, 0]), StoredImages.of(depth, pairs[:, 1]), left_out)


def _pair_gap_s(recording: Recording, colour: ImageTimes, depth: ImageTimes) -> float:
    """Return half the shorter frame period [s], 0.1 s at most."""
    periods: list[float] = []
    for times in (colour, depth):
        rate = rs.frame_rate(recording, times.topic.name)
        periods.append(1 / rate if rate else joints.period_s(times.stamp_ns))
    return min(min(periods) / 2, joints.MAX_PAIR_GAP_S)


def _check_domains(colour: ImageTimes, depth: ImageTimes) -> None:
    """Refuse two streams of librealsense that were stamped by different clocks."""
    if colour.frames is None or depth.frames is None:
        return
    if colour.frames.domains != depth.frames.domains:
        raise InputError(
            f"{colour.topic.name} was stamped by {sorted(colour.frames.domains)} and "
            f"{depth.topic.name} by {sorted(depth.frames.domains)}: they cannot be compared. Join "
            "them by the time of recording (clock=receive)."
        )


def _still(
    colour: StoredImages,
    depth: StoredImages | None,
    arm: ArmAtFrames,
    choice: BagChoice,
    left_out: dict[str, list[float]],
) -> tuple[StoredImages, StoredImages | None, ArmAtFrames]:
    """Return what is left without the frames at which the arm moved.

    Raises:
        InputError: nothing is left.
    """
    keep = arm.still(choice.still_speed)
    if not np.any(keep):
        raise InputError(
            f"at none of the {len(keep)} frames the arm is known to stand (still_speed "
            f"{choice.still_speed}); the slowest is {np.nanmin([*arm.speeds, np.inf]):.3f}. Raise "
            "still_speed=, or leave only_still out."
        )
    lost = colour.stamp_ns[~keep] / NS_PER_S
    left_out["moving"] = [round(float(t), 6) for t in lost]
    rows = {
        name: None if getattr(arm, name) is None else getattr(arm, name)[keep]
        for name in ("joints", "Ts_base_ee", "Ts_world_cam", "speeds")
    }
    kept_depth = None if depth is None else depth.at(keep)
    return colour.at(keep), kept_depth, replace(arm, **rows)


def _unit(
    recording: Recording, depth: StoredImages, topics: Topics, found: Scan, choice: BagChoice
) -> tuple[float, str]:
    """Return metres per count and where that comes from, from a few depth images."""
    assert topics.depth is not None
    chosen = np.linspace(0, len(depth.stamp_ns) - 1, UNIT_SAMPLES).astype(int)
    reader = Messages(recording, [depth])
    images = [
        pixels.depth_of(reader.one(0, int(n)), depth.compressed, depth.topic)
        for n in np.unique(chosen)
    ]
    recorded = rs.depth_unit_m(recording, depth.topic)
    frames = found.depth.frames if found.depth is not None else None
    units = sorted(frames.units) if frames is not None else []
    if len(units) > 1:
        raise InputError(
            f"{depth.topic}: the depth unit changes during the recording ({units} m); a session "
            "has one. Cut the recording where it changes."
        )
    recorded = units[0] if units else recorded
    encoding = topics.depth.image.encoding
    return unit_of(images, depth.topic, encoding, choice.depth_unit_m, recorded)


def _content_key(recording: Recording, topics: Topics, found: Scan, choice: BagChoice) -> str:
    """Return a digest of what tells this recording and this choice from others, wherever it is."""
    images = [i for i in (found.colour, found.depth) if i is not None]
    digest = hashlib.sha256()
    for image in images:
        digest.update(image.topic.name.encode())
        digest.update(image.stamp_ns.tobytes() + image.receive_ns.tobytes())
    counts = sorted((t.name, t.count) for t in recording.topics.values())
    arm = (topics.joints, topics.joint_prefix, topics.tf)
    # A UR's joints were the only ones once: recordings of it keep their digest.
    usual = {"intrinsics", *(["joint_names"] if choice.joint_names == UR_JOINTS else [])}
    said = {n: str(getattr(choice, n)) for n in CHOICE_NAMES if n not in usual}
    digest.update(json.dumps([counts, arm, said, found.clock]).encode())
    return digest.hexdigest()


def _extra(
    recording: Recording,
    topics: Topics,
    found: Scan,
    choice: BagChoice,
    left_out: dict[str, list[float]],
) -> dict[str, Any]:
    depth = None if topics.depth is None else topics.depth.name
    return {
        "kind": "bag",
        "path": str(recording.path.resolve()),
        "content_key": _content_key(recording, topics, found, choice),
        "source": recording.path.name,
        "container": recording.container,
        "clock": found.clock,
        "topics": {
            "colour": topics.colour.name,
            "depth": depth,
            "camera_info": topics.colour_info,
            "depth_camera_info": topics.depth_info,
            "joints": topics.joints,
            "tf": list(topics.tf),
        },
        "left_out_s": left_out,
        "camera": rs.device_info(recording, topics.colour.name),
    }
