"""What a plain folder needs besides its images: the camera and the robot's poses, from its files.

The readers are those of `realsim calibrate`, so that both take the same files.
"""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats import folders
from realsim.formats.folders.listing import shown
from realsim.formats.folders.source import require_one_size
from realsim.records import CameraIntrinsics
from realsim.robots.arm import find_arm, known_chains

CAMERA_NAME = re.compile(r"cam|intrin|calib|^k$", re.IGNORECASE)
"""Names of files that may hold a camera."""
CAMERA_ENDINGS = (".json", ".yaml", ".yml", ".xml", ".txt")
MOST_CAMERA_BYTES = 200_000
"""A larger file is no camera's."""
POSE_PLACES = (".", "poses", "pose", "robot", "robot_poses", "tcp")
"""Where poses may be in a folder, if it was not said."""
SMALLEST_BOP_SCALE = 0.02
"""depth_scale in a camera.json is millimetres per count in BOP (0.1, 1) and metres per count in
other programs (0.001): below this it is not BOP's, and is not taken."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ImportRequest:
    """What `realsim import` was asked for."""

    source: Path
    kind: str = "auto"
    intrinsics: Path | None = None
    """File with the intrinsics."""
    depth_unit: float | None = None
    """Metres per count of the depth."""
    depth_coding: str = "auto"
    no_depth: bool = False
    images: str = ""
    """Folder of the colour images, in the source."""
    depths: str = ""
    """Folder of the depth images, in the source."""
    poses: Path | None = None
    no_poses: bool = False
    reading: str = ""
    key: str = ""
    poses_of: str = "tool"
    colour_topic: str | None = None
    depth_topic: str | None = None
    arm: str | None = None
    """Name or folder of the arm; None = a UR's joints in a recording, any in a folder."""
    joints_topic: str | None = None
    camera_info_topic: str | None = None
    depth_camera_info_topic: str | None = None
    joint_prefix: str | None = None
    base_frame: str | None = None
    ee_frame: str | None = None
    world_frame: str | None = None
    clock: Literal["header", "receive"] = "header"
    max_pair_gap: float | None = None
    """Greatest time between colour and its depth [s]."""
    only_still: bool = False
    scene: int | None = None
    camera_name: str = ""
    """Camera of a data set with several cameras: kinect, cam1 ..."""
    models: Path | None = None
    """Folder of the models, when it is not in the data set."""
    no_labels: bool = False
    """Leave poses, masks and models of a data set where they are."""
    camera_id: int | None = None
    scale: float | None = None
    """Metres per unit of a COLMAP model or of a transforms.json."""

    def folder_choice(self) -> folders.FolderChoice:
        """Return what is asked of a folder's images."""
        return folders.FolderChoice(
            colour=self.images, depth=self.depths, use_depth=not self.no_depth,
            depth_unit_m=self.depth_unit, depth_coding=self.depth_coding,
        )  # fmt: skip


def open_image_folder(request: ImportRequest) -> tuple[folders.FolderSource, list[str]]:
    """Return a folder as a frame source, and what was decided on the way.

    Raises:
        InputError: as `open_folder`, or the camera or the poses cannot be read.
    """
    root, choice = request.source, request.folder_choice()
    listing = folders.list_folder(root, colour=choice.colour, depth=choice.depth)
    size = require_one_size(listing.colour, "colour images")
    notes: list[str] = []
    states: list[Sequence[folders.FrameState]] = []
    info_path = folders.find_cam_info(listing.root)
    info = None if info_path is None else folders.read_cam_info(info_path)
    if info is not None and info.states:
        states.append(info.states)
        notes.append(f"camera poses from {info.path.name}, in metres, camera to world.")
    camera: CameraIntrinsics | None
    if request.intrinsics is not None:
        camera = camera_of_file(request.intrinsics, size)
    elif info is not None:
        camera = CameraIntrinsics.from_K(info.K, *size)
        notes.append(f"camera from {info.path.name}; it has no distortion.")
    else:
        camera, said = _camera_in(listing, size)
        notes += said
    poses, said = _poses(listing, request, has_states=bool(states))
    notes += said
    states += [poses] if poses else []
    unit_m, said = _stated_unit(listing, request)
    notes += said
    if choice.depth_unit_m is None and unit_m is not None:
        choice = replace(choice, depth_unit_m=unit_m)
    source = folders.open_folder(root, camera, states, choice=choice, listing=listing)
    return source, notes


# --- camera -----------------------------------------------------------------------------------


def camera_of_file(path: Path, size: tuple[int, int] | None) -> CameraIntrinsics:
    """Return the camera in a file, of any format that `realsim calibrate --intrinsics` reads.

    A text file of nine numbers is a camera matrix; it, or a file that names no image size, holds
    for images of `size` if its principal point lies near their centre.

    Args:
        path: the file.
        size: (width, height) [px] of the images, None where not known.

    Raises:
        InputError: no camera in it, or a matrix of another image size.
    """
    from realsim_calibration.lens.camera_files import read_camera, require_centred

    K = _matrix_text(path)
    if K is None:
        return read_camera(path, size=size)
    if size is None:
        raise InputError(
            f"{path} holds a camera matrix without an image size; give a file that says it, too."
        )
    require_centred(K, size, path)
    return CameraIntrinsics.from_K(K, *size)


def _matrix_text(path: Path) -> Array | None:
    """Return the matrix of a text file that holds nine numbers and nothing else."""
    if path.suffix.lower() not in (".txt", ".csv", "") or not path.is_file():
        return None
    if path.stat().st_size > MOST_CAMERA_BYTES:
        return None
    lines = path.read_text(errors="replace").splitlines()
    words = re.split(r"[\s,;\[\]]+", " ".join(line.split("#")[0] for line in lines))
    try:
        numbers = [float(w) for w in words if w]
    except ValueError:
        return None
    return np.array(numbers).reshape(3, 3) if len(numbers) == 9 else None


def camera_files(listing: folders.ImageFolder) -> list[Path]:
    """Return the files of a folder whose names may mean a camera."""
    places = dict.fromkeys([listing.root, listing.colour[0].path.parent])
    return sorted(
        p
        for place in places
        for p in place.iterdir()
        if p.suffix.lower() in CAMERA_ENDINGS
        and CAMERA_NAME.search(p.stem)
        and p.is_file()
        and p.stat().st_size <= MOST_CAMERA_BYTES
    )


def _camera_in(
    listing: folders.ImageFolder, size: tuple[int, int]
) -> tuple[CameraIntrinsics | None, list[str]]:
    """Return the one camera that the folder's files hold, None where there is none.

    Raises:
        InputError: several different ones.
    """
    found: list[tuple[Path, CameraIntrinsics]] = []
    failed: list[str] = []
    for path in camera_files(listing):
        try:
            camera = camera_of_file(path, size)
        except InputError as error:
            failed.append(str(error))
            continue
        if (camera.width, camera.height) == size:
            found.append((path, camera))
        else:
            failed.append(f"{path.name} is of {camera.width}x{camera.height} px.")
    if not found and failed:
        raise InputError(
            f"the camera of the images ({size[0]}x{size[1]} px) is not known: {' '.join(failed)} "
            "Give --intrinsics FILE."
        )
    if not found:
        return None, []
    first = found[0][1]
    if any(not _equal(first, camera) for _, camera in found[1:]):
        raise InputError(
            f"{listing.root} holds several cameras: {', '.join(p.name for p, _ in found)}. Say "
            f"which is the colour camera's: --intrinsics {found[0][0]}."
        )
    return first, [f"camera from {found[0][0].name}."]


def _equal(a: CameraIntrinsics, b: CameraIntrinsics) -> bool:
    return bool(np.array_equal(a.K, b.K) and np.array_equal(a.distortion, b.distortion))


def _stated_unit(
    listing: folders.ImageFolder, request: ImportRequest
) -> tuple[float | None, list[str]]:
    """Return the depth unit [m] that a BOP camera.json beside the images states."""
    if request.depth_unit is not None or not listing.depth:
        return None, []
    files = [p for p in camera_files(listing) if p.suffix.lower() == ".json"]
    for path in [request.intrinsics] if request.intrinsics is not None else files:
        try:
            values: Any = json.loads(path.read_text())
            scale = float(values["depth_scale"])
        except (OSError, ValueError, KeyError, TypeError):
            continue
        if scale >= SMALLEST_BOP_SCALE:
            said = f"depth unit from {path.name}: depth_scale {scale:g} mm per count, as in BOP."
            return scale / 1000, [said]
    return None, []


# --- poses ------------------------------------------------------------------------------------


def _poses(
    listing: folders.ImageFolder, request: ImportRequest, *, has_states: bool
) -> tuple[list[folders.FrameState], list[str]]:
    """Return the poses that were given or found, and what was decided.

    Raises:
        InputError: they were given and cannot be read, or how to read them is not clear.
    """
    from realsim_calibration.inputs.pose_file import read_pose_file
    from realsim_calibration.inputs.raw_poses import listed_readings
    from realsim_calibration.inputs.readings import reading_from_text

    if request.poses is None and (request.no_poses or has_states):
        return [], []
    raw = None
    if request.poses is not None:
        raw = read_pose_file(request.poses, key=request.key or None)
    else:
        for place in dict.fromkeys((*POSE_PLACES, listing.colour[0].path.parent)):
            try:
                raw = read_pose_file(listing.root / place, key=request.key or None)
                break
            except InputError:
                continue
    if raw is None:
        return [], ["no robot poses were found: the views have none. Give them with --poses."]
    measured = [k for k, fine in enumerate(raw.measured) if fine]
    lost = len(raw) - len(measured)
    raw = raw.subset(measured)
    reading = reading_from_text(request.reading) if request.reading else raw.stated
    if reading is None:
        raise InputError(
            f"{raw.path}: how the poses are to be read is not clear from the file: "
            f"{listed_readings(raw.possible)}. Give --reading, such as --reading "
            f"{raw.possible[0]}; `realsim calibrate` proves it with the images of a target; or "
            "--no-poses."
        )
    Ts = raw.poses(reading)
    joints = raw.joints
    if joints is not None and request.arm:
        arm = find_arm(request.arm)
        if joints.shape[1] != arm.joints:
            alike = ", ".join(known_chains(joints.shape[1])) or "none that is found by name"
            raise InputError(
                f"{raw.path} has {joints.shape[1]} joint angles a pose, and --arm {request.arm}, a "
                f"{arm.name}, has {arm.joints} joints. Name the arm that they are of ({alike}), or "
                "leave --arm out."
            )
    field = {"tool": "T_base_ee", "camera": "T_world_cam"}[request.poses_of]
    states = [
        folders.FrameState(
            name=raw.labels[k] or raw.stems[k], where=raw.where[k],
            joints=None if joints is None else joints[k], **{field: Ts[k]},
        )
        for k in range(len(raw))
    ]  # fmt: skip
    notes = [f"poses of the {request.poses_of} from {raw.path.name}, read as {reading}."]
    if lost:
        notes.append(f"{lost} poses hold NaN or infinite numbers and were left out.")
    return states, [*notes, *raw.notes]


def describe_folder(request: ImportRequest) -> list[tuple[str, str]]:
    """Return what a folder holds, for --list, without importing it."""
    root, choice = request.source, request.folder_choice()
    listing = folders.list_folder(root, colour=choice.colour, depth=choice.depth)
    rows: list[tuple[str, str]] = []
    for what, files in (("colour", listing.colour), ("depth", listing.depth)):
        sizes = sorted({f"{f.width}x{f.height}" for f in files})
        names = shown([f.path.relative_to(listing.root).as_posix() for f in files], 4)
        rows.append((what, f"{len(files)} images, {', '.join(sizes) or 'none'} ({names})"))
    if listing.depth:
        from realsim.formats.folders.depth_evidence import coding_of, depth_evidence, unit_choices

        evidence = depth_evidence([f.path for f in listing.depth])
        try:
            coding, why = coding_of(evidence, choice.depth_coding, str(root))
            rows.append(("depth unit", f"{why} {unit_choices(evidence, coding)}".strip()))
        except InputError as error:
            rows.append(("depth unit", str(error)))
    cameras = [p.name for p in camera_files(listing)]
    info = folders.find_cam_info(listing.root)
    rows.append(("camera files", shown(cameras) or "none"))
    if info is not None:
        rows.append(("camera poses", f"{len(folders.read_cam_info(info).states)} in {info.name}"))
    try:
        states, notes = _poses(listing, request, has_states=info is not None)
        rows.append(("poses", f"{len(states)}. {' '.join(notes)}"))
    except InputError as error:
        rows.append(("poses", str(error)))
    return rows + [("left aside", text) for text in listing.ignored]
