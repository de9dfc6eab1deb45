"""Where the arm was at every frame: joints by name, flange pose by tf, and whether it stood."""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array, Int64, Mask
from realsim.errors import InputError
from realsim.formats.bags.joints import UR_JOINTS, check_overlap
from realsim.formats.bags.scan import Scan
from realsim.formats.bags.tf_tree import arm_frames
from realsim.formats.bags.topics import BagChoice, Topics


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ArmAtFrames:
    """The arm at N frames; NaN where it is not known."""

    joints: Array | None
    """(N, 6) [rad]; None if the recording has none."""
    Ts_base_ee: Array | None
    """(N, 4, 4) [m]; None if the recording has none."""
    Ts_world_cam: Array | None
    """(N, 4, 4) [m]; None unless asked for."""
    speeds: Array
    """(N,) how fast the arm moved [rad/s or m/s]; NaN where not known."""
    notes: tuple[str, ...]

    def still(self, speed: float) -> Mask:
        """Return (N,) whether the arm is known to have stood."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.speeds <= speed)

    def row(self, values: Array | None, n: int) -> Array | None:
        """Return entry n, or None where it is not known."""
        return None if values is None or np.isnan(values[n]).any() else values[n]


def arm_at(times_ns: Int64, scan: Scan, topics: Topics, choice: BagChoice) -> ArmAtFrames:
    """Return where the arm was at the times of the frames.

    Raises:
        InputError: the arm's clock is another one, or tf leaves more than one arm to choose.
    """
    gap = choice.max_arm_gap_s
    speeds = np.full(len(times_ns), np.nan)
    notes: list[str] = []
    joints = _joints(times_ns, scan, topics, gap, speeds, notes)
    tree = scan.tree
    Ts: Array | None = None
    is_ur = joints is not None and choice.joint_names == UR_JOINTS
    frames = arm_frames(tree, choice.base_frame, choice.ee_frame, is_ur)
    if frames is not None:
        base, ee, T_base_frame, found = frames
        notes += found
        moving = tree.times_ns(base, ee)
        if len(moving):
            check_overlap(topics.colour.name, times_ns, f"tf {base} -> {ee}", moving, scan.clock)
        Ts = _poses(scan, times_ns, base, ee, gap)
        Ts = T_base_frame @ Ts
        notes += _unknown(f"tf {base} -> {ee}", np.isnan(Ts[:, 0, 0]), gap)
        if joints is None:
            speeds[:] = [tree.speed(base, ee, int(t), gap) for t in times_ns]
    elif joints is None:
        notes.append("neither the arm's joints nor tf to its flange were recorded: images alone.")
    Ts_world: Array | None = None
    if choice.world_frame is not None:
        Ts_world = _world(scan, times_ns, choice.world_frame, topics.colour.frame_id, gap, notes)
    moved = int(np.sum(~(speeds <= choice.still_speed) & ~np.isnan(speeds)))
    if moved:
        fastest = float(np.nanmax(speeds))
        notes.append(
            f"the arm moved at {moved} of {len(times_ns)} frames (up to {fastest:.3f} per s, "
            f"{choice.still_speed} is taken as standing); "
            + ("they were left out." if choice.only_still else "only_still leaves them out.")
        )
    return ArmAtFrames(
        joints=joints, Ts_base_ee=Ts, Ts_world_cam=Ts_world, speeds=speeds, notes=tuple(notes)
    )


def _joints(
    times_ns: Int64, scan: Scan, topics: Topics, gap: float, speeds: Array, notes: list[str]
) -> Array | None:
    """Return joints (N, n) with NaN in gaps, and fill in the speeds; None without a track."""
    track = scan.joints
    if track is None or not len(track.times_ns):
        return None
    name = str(topics.joints)
    check_overlap(topics.colour.name, times_ns, name, track.times_ns, scan.clock)
    joints = np.full((len(times_ns), track.q.shape[1]), np.nan)
    for n, t in enumerate(times_ns):
        found = track.at(int(t), gap)
        if found is not None:
            joints[n], speeds[n] = found
    notes += _unknown(name, np.isnan(joints[:, 0]), gap)
    return joints


def _poses(scan: Scan, times_ns: Int64, a: str, b: str, gap: float) -> Array:
    """Return T_a_b (N, 4, 4), NaN in gaps."""
    Ts = np.full((len(times_ns), 4, 4), np.nan)
    for n, t in enumerate(times_ns):
        T = scan.tree.lookup(a, b, int(t), gap)
        if T is not None:
            Ts[n] = T
    return Ts


def _world(
    scan: Scan, times_ns: Int64, world: str, camera: str, gap: float, notes: list[str]
) -> Array:
    """Return T_world_cam (N, 4, 4), NaN in gaps.

    Raises:
        InputError: tf does not join the two frames.
    """
    if scan.tree.chain(world, camera) is None:
        raise InputError(
            f"tf does not join world_frame={world} and the colour images' frame '{camera}'; its "
            f"frames are {', '.join(scan.tree.frames) or 'none'}."
        )
    Ts = _poses(scan, times_ns, world, camera, gap)
    notes += _unknown(f"tf {world} -> {camera}", np.isnan(Ts[:, 0, 0]), gap)
    return Ts


def _unknown(name: str, missing: Mask, gap: float) -> list[str]:
    if not np.any(missing):
        return []
    return [
        f"{name} has a gap of more than {gap:g} s at {int(missing.sum())} of {len(missing)} "
        "frames: they were imported without it."
    ]
