"""Held-out accuracy on real sets: lens and hand-eye from some views, the board in the others.

Imported by `calibration.py`. px of a seed: RMS over all test views of the per-view 2-D RMS, each
view projected by the calibration of the folds without it, through its robot pose and its map.
"""

import json
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from realsim.arrays import Array, Rows
from realsim.errors import RealsimError
from realsim.geometry import se3
from realsim.geometry.camera import project
from realsim.geometry.dh import DhArm
from realsim.records import ArmErrorMap, CameraIntrinsics, Target
from realsim.robots.arm import UR5 as UR5_ARM
from realsim.robots.arm import UR5E as UR5E_ARM
from realsim_calibration import (
    BoardView,
    HandEyeReport,
    TargetDetection,
    calibrate,
    calibrate_from_poses,
    find_target,
)
from realsim_calibration.inputs.folder import read_board_poses, read_image_folder
from realsim_calibration.inputs.image_files import load_image
from realsim_calibration.inputs.readings import reading_from_text
from realsim_calibration.results import BoardShape
from realsim_calibration.targets.target_text import parse_target

FOLDS = 5
MIN_POINTS = 8
"""Fewest points of a view that counts: with less, a view's RMS says little."""


class Source(NamedTuple):
    """Where a set is and how it is to be read."""

    images: str
    poses: str
    target: str
    reading: str
    arm: DhArm | None = None


SOURCES = {
    "rtde": Source(
        "rtde_ur5e/Hand-Eye-Data", "rtde_ur5e/Hand-Eye-Data",
        "charuco:5x7,square=33mm,marker=20mm,dict=6X6_100", "rotvec,m", UR5E_ARM,
    ),
    "rosi": Source(
        "rosi_circles/images", "rosi_circles/cal_data.yaml",
        "circles:10x10,pitch=25.4mm,large-origin", "quat_xyzw,m",
    ),
    "muligheder": Source(
        "muligheder_ur5e/images", "muligheder_ur5e/40_poses_test.txt",
        "chessboard:9x6,square=21.9mm", "rotvec,m",
    ),
}  # fmt: skip
"""The open sets; the pitch of muligheder's board is documented nowhere and fits 21.9 mm."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ImageSet:
    """Detected views with their poses."""

    name: str
    target: Target
    Ts: Array
    """(n, 4, 4) T_base_ee [m]."""
    joints: Array | None
    detections: tuple[TargetDetection, ...]
    labels: tuple[str, ...]
    arm: DhArm | None

    def folds(self, seed: int) -> Rows:
        """Return the fold (n,) of every view."""
        order = np.random.default_rng(seed).permutation(len(self.Ts))
        fold = np.empty(len(order), dtype=np.int64)
        fold[order] = np.arange(len(order)) % FOLDS
        return fold


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Fold:
    """One calibration to be run: which views train, and what is done to them."""

    data: ImageSet
    seed: int
    number: int
    joints: bool = False
    swap: bool = False

    def training(self) -> Rows:
        """Return the training views."""
        return np.flatnonzero(self.data.folds(self.seed) != self.number)

    def swapped(self) -> tuple[int, int] | None:
        """Return the two training views whose poses are swapped."""
        if not self.swap:
            return None
        rng = np.random.default_rng([self.seed, self.number, 1])
        a, b = sorted(int(v) for v in rng.choice(self.training(), 2, replace=False))
        return a, b


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FoldResult:
    """What one calibration predicted."""

    set_name: str
    seed: int
    number: int
    px: tuple[float, ...]
    """Per test view; infinite where nothing was calibrated."""
    alone_px: tuple[float, ...] = ()
    """The same by what is exported for programs that know no map: X_alone, Z_alone, its lens, and
    the board as drawn."""
    rejected: tuple[int, ...] = ()
    swapped: tuple[int, int] | None = None
    map_name: str = ""
    said: str = ""
    """The refusal, where there was one."""


def detect(task: tuple[Path, str]) -> TargetDetection:
    """Return the target's points in one image."""
    path, target = task
    return find_target(load_image(path), parse_target(target))


def image_tasks(data: Path, name: str) -> list[tuple[Path, str]]:
    """Return what `detect` is to be given for a set."""
    source = SOURCES[name]
    folder = read_image_folder(data / "handeye" / source.images, data / "handeye" / source.poses)
    return [(path, source.target) for path in folder.images]


def image_set(data: Path, name: str, found: Sequence[TargetDetection], step: int = 1) -> ImageSet:
    """Return a set of its detections, in the order of `image_tasks`; views without are left out."""
    source = SOURCES[name]
    folder = read_image_folder(data / "handeye" / source.images, data / "handeye" / source.poses)
    Ts = folder.Ts_base_ee(reading_from_text(source.reading))
    good = [k for k, d in enumerate(found) if len(d) >= MIN_POINTS]
    keep = [step * k for k in good]
    return ImageSet(
        name=name, target=parse_target(source.target), Ts=Ts[keep], arm=source.arm,
        joints=None if folder.joints is None else folder.joints[keep],
        detections=tuple(found[k] for k in good), labels=tuple(folder.labels[k] for k in keep),
    )  # fmt: skip


def shaped(shape: BoardShape, drawn: Array) -> Array:
    """Return a board's points (m, 3) as the calibration found them printed and bent [m]."""
    middle = (drawn.max(0) + drawn.min(0)) / 2
    x, y = (drawn - middle)[:, :2].T
    w = shape.warp
    lift = (w[0] * x * x + w[1] * x * y + w[2] * y * y) / shape.half_extent_m
    return middle + shape.scale * np.stack([x, (1 + shape.aspect) * y, lift], -1)


def corrected(report: HandEyeReport, T: Array, joints: Array | None) -> Array:
    """Return where the robot is by the report's map (4, 4)."""
    if report.robot_map is None:
        return T
    if isinstance(report.robot_map, ArmErrorMap):
        assert joints is not None
        return report.robot_map.corrected(T, joints)
    return report.robot_map.corrected(T)


def run_fold(fold: Fold) -> FoldResult:
    """Calibrate on the training views and predict the others."""
    data, train, swapped = fold.data, fold.training(), fold.swapped()
    test = np.setdiff1d(np.arange(len(data.Ts)), train)
    q = data.joints if fold.joints else None
    pose_of = np.arange(len(data.Ts))
    if swapped is not None:
        pose_of[list(swapped)] = swapped[::-1]
    views = [
        BoardView(
            index=int(k), T_base_ee=data.Ts[pose_of[k]], detection=data.detections[k],
            name=data.labels[k], joints=None if q is None else q[pose_of[k]],
        )
        for k in train
    ]  # fmt: skip
    where: dict[str, Any] = {"set_name": data.name, "seed": fold.seed, "number": fold.number}
    where["swapped"] = swapped
    try:
        report = calibrate(views, data.target, arm=data.arm if fold.joints else None).hand_eye
    except RealsimError as error:
        bad = (float("inf"),) * len(test)
        return FoldResult(px=bad, alone_px=bad, said=str(error), **where)
    points = shaped(report.board, report.target.points_board)
    px, alone = list[float](), list[float]()
    for k in test:
        T, seen = data.Ts[k], data.detections[k]
        moved = corrected(report, T, None if q is None else q[k])
        T_cam_board = se3.invert(moved @ report.X) @ report.Z
        px.append(view_px(seen, report.intrinsics, T_cam_board, points))
        T_cam_board = se3.invert(T @ report.X_alone) @ report.Z_alone
        drawn = data.target.points_board
        alone.append(view_px(seen, report.intrinsics_alone, T_cam_board, drawn))
    return FoldResult(
        px=tuple(px), alone_px=tuple(alone), map_name=report.map_name,
        rejected=tuple(i for i, _ in report.rejected), **where,
    )  # fmt: skip


def view_px(
    seen: TargetDetection, camera: CameraIntrinsics, T_cam_board: Array, points: Array
) -> float:
    """Return the RMS [px] of a view's points, infinite where they are behind the camera."""
    uv = project(camera, se3.transform(T_cam_board, points[seen.point_ids]))
    error = float(np.sqrt(np.mean(np.sum((uv - seen.uv) ** 2, -1))))
    return error if np.isfinite(error) else float("inf")


def px_by_seed(
    results: Sequence[FoldResult], name: str, *, alone: bool = False
) -> list[float]:  # fmt: skip
    """Return a set's held-out RMS [px], one per seed; `alone`: without the robot's map."""
    found: dict[int, list[float]] = {}
    for r in results:
        if r.set_name == name:
            found.setdefault(r.seed, []).extend(r.alone_px if alone else r.px)
    return [float(np.sqrt(np.mean(np.square(found[seed])))) for seed in sorted(found)]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PoseSet:
    """The pose-only set."""

    A: Array
    C: Array
    joints: Array


def read_koch(data: Path) -> PoseSet:
    """Return the pose-only set: matrices in mm, joints in degrees."""
    folder = data / "handeye" / "koch_ur5"
    given = read_board_poses(folder / "robot_poses.yaml", folder / "cam_poses.yaml")
    reading = reading_from_text("matrix,mm")
    joints = np.radians(json.loads((folder / "meta.json").read_text())["joints"])
    return PoseSet(A=given.robot.poses(reading), C=given.board.poses(reading), joints=joints)


def left_out_mm(task: tuple[PoseSet, int, bool]) -> tuple[float, ...]:
    """Return how far the board, seen in view k, is from where a calibration without k has it [mm].

    Once with the robot's map, once by X_alone.
    """
    poses, k, with_joints = task
    rest = np.arange(len(poses.A)) != k
    report = calibrate_from_poses(
        poses.A[rest], poses.C[rest], joints=poses.joints[rest] if with_joints else None,
        arm=UR5_ARM if with_joints else None,
    )  # fmt: skip
    T = corrected(report, poses.A[k], poses.joints[k])
    return tuple(
        1e3 * float(np.linalg.norm((at @ X @ poses.C[k])[:3, 3] - Z[:3, 3]))
        for at, X, Z in ((T, report.X, report.Z), (poses.A[k], report.X_alone, report.Z_alone))
    )


@dataclass(eq=False, kw_only=True, slots=True)
class Referee:
    """OpenCV's closed forms at work in an environment of their own."""

    process: "subprocess.Popen[bytes]"
    folder: "tempfile.TemporaryDirectory[str]" = field(repr=False)

    @classmethod
    def start(
        cls, sets: Sequence[ImageSet], poses: PoseSet | None, seeds: Sequence[int]
    ) -> "Referee":
        """Start the referee on the same folds and corners."""
        folder = tempfile.TemporaryDirectory()
        arrays: dict[str, Any] = {}
        for s in sets:
            counts = [len(d) for d in s.detections]
            arrays[f"{s.name}_A"], arrays[f"{s.name}_points"] = s.Ts, s.target.points_board
            arrays[f"{s.name}_ids"] = np.concatenate([d.point_ids for d in s.detections])
            arrays[f"{s.name}_uv"] = np.concatenate([d.uv for d in s.detections])
            arrays[f"{s.name}_start"] = np.concatenate([[0], np.cumsum(counts)])
            arrays[f"{s.name}_size"] = s.detections[0].image_size
            arrays[f"{s.name}_folds"] = np.array([s.folds(seed) for seed in seeds])
        if poses is not None:
            arrays |= {"poses_A": poses.A, "poses_C": poses.C}
        np.savez(Path(folder.name) / "in.npz", **arrays)
        script = Path(__file__).with_name("calibration_referee.py")
        command = [
            "uv", "run", "--no-project", "--isolated", "--quiet",
            "--with", "opencv-python-headless<5", "--with", "numpy", "python", str(script),
            "in.npz", "out.json",
        ]  # fmt: skip
        process = subprocess.Popen(command, cwd=folder.name, stderr=subprocess.PIPE)
        return cls(process=process, folder=folder)

    def result(self) -> tuple[dict[str, Any] | None, str]:
        """Wait for the figures; None and the reason where the referee could not run."""
        _, error = self.process.communicate()
        try:
            if self.process.returncode:
                return None, error.decode(errors="replace").strip()[-300:]
            return json.loads((Path(self.folder.name) / "out.json").read_text()), ""
        finally:
            self.folder.cleanup()
