"""The board views of a session: read them for the calibration, leave its results beside them.

The target in the images of a folder: found once and noted, and refused where it is nowhere.
"""

import hashlib
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from realsim.app.console import Console, Tick
from realsim.arrays import Array
from realsim.errors import InputError, RealsimError
from realsim.geometry.dh import DhArm
from realsim.interop import cores
from realsim.records import CameraIntrinsics, Target
from realsim.records.targets import CharucoBoard, Chessboard, CircleGrid
from realsim.robots.arm import find_arm, known_chains
from realsim.robots.robot_files import same_name
from realsim.store import SessionStore, atomic
from realsim.store.atomic import write_json
from realsim.untrusted.own_json import read_own, read_values, to_json
from realsim_calibration import (
    BoardView,
    DepthBoardView,
    HandEyeReport,
    TargetDetection,
    estimate_depth_bias,
    find_target,
)
from realsim_calibration.depth.bias import DepthBiasReport
from realsim_calibration.fit.robot_error import matching_arm

if TYPE_CHECKING:
    from realsim_calibration.inputs.folder import FolderInput


BOARD_FILE = "calibration/board.json"
DEPTH_FILE = "calibration/depth_bias.json"
"""What is known of the depth camera's scale and offset."""
RESULTS = "calibration"
"""Folder of the session that takes report, pictures and exports."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibrationFolder:
    """The folder of a session that is not begun: its files have no list of checksums yet."""

    folder: Path
    """What will be the session's folder."""

    def write_json(self, relative: str, value: Any) -> None:
        """Write plain JSON values, whole or not at all."""
        atomic.write_json(self.folder / relative, value)


SessionFiles = SessionStore | CalibrationFolder
"""Files of a session by their paths inside it."""


def read_board_views(
    store: SessionFiles, views_store: SessionStore, arm: str, tick: Tick
) -> tuple[list[BoardView], Target, DhArm | None]:
    """Return the board views with the points found, the target, and the arm if it can be told.

    Args:
        store: what holds the target's file.
        views_store: the board views.
        arm: name or folder of the arm; empty = the one that the session names or the poses prove.
        tick: told how far the work is.

    Raises:
        InputError: no target file, a view without a robot pose, or views of another arm.
    """
    from realsim_calibration.targets.target_file import target_from_json

    if not (store.folder / BOARD_FILE).is_file():
        raise InputError(
            f"session '{store.folder}' has no {BOARD_FILE}, so the printed target is not known. "
            "`realsim board` writes one beside every sheet: copy it there."
        )
    target = target_from_json(read_values(store.folder / BOARD_FILE))
    views, camera = views_store.session.views, views_store.session.intrinsics
    taken_with = str(views_store.extra.get("arm", ""))
    named = find_arm(arm).chain if arm else None
    if named is not None and taken_with and not same_name(taken_with, named.name):
        raise InputError(
            f"the views of '{views_store.folder}' were captured with a {taken_with}, and --arm "
            f"{arm} is a {named.name}: its joints and links say nothing of these views. Leave "
            f"--arm out, or give --arm {taken_with}."
        )
    seen: list[BoardView] = []
    for k, view in enumerate(views):
        if view.T_base_ee is None:
            raise InputError(f"board view {view.index} has no robot pose.")
        found = find_target(views_store.rgb(view.index), target, intrinsics=camera)
        seen.append(
            BoardView(
                index=view.index, T_base_ee=view.T_base_ee, detection=found, joints=view.joints
            )
        )
        tick(k + 1, len(views))
    if named is None:
        return seen, target, arm_of(seen, taken_with)
    if any(view.joints is None for view in seen):
        raise InputError(
            f"--arm {arm} needs joint angles with every view; those of '{views_store.folder}' have "
            "none. Leave --arm out."
        )
    return seen, target, named.bare()


def arm_of(views: Sequence[BoardView], name: str = "") -> DhArm | None:
    """Return the arm that the joints and poses of all views prove, None where they do not.

    Of several with the same numbers the one of this name is taken, or else the first.
    """
    joints = [v.joints for v in views if v.joints is not None]
    if len(joints) < len(views) or len({len(q) for q in joints}) != 1:
        return None
    return arm_of_poses(np.array([v.T_base_ee for v in views]), np.array(joints), name)


def known_arm(
    name: str, Ts_base_ee: Sequence[Array], joints: Sequence[Array | None], console: Console
) -> DhArm | None:
    """Return the arm that was named, or that poses (4, 4) and joints [rad] prove, and tell it.

    Raises:
        InputError: an arm that is not known, or one without joints.
    """
    given = [q for q in joints if q is not None]
    complete = bool(given) and len(given) == len(Ts_base_ee) and len({len(q) for q in given}) == 1
    if name:
        arm = find_arm(name).chain.bare()
        if not complete:
            raise InputError(f"--arm {name} needs joint angles with every pose; there are none.")
        return arm
    if not complete:
        return None
    arm = arm_of_poses(np.array(Ts_base_ee), np.array(given))
    if arm is not None:
        console.say(f"joints and poses are those of a {arm.name}: its own errors are modelled.")
    else:
        console.warn(
            "the joints beside the poses are those of no arm that is known: they are not used. "
            "Name the arm: --arm ur5e, or its folder."
        )
    return arm


def arm_of_poses(Ts_base_ee: Array, joints: Array, name: str = "") -> DhArm | None:
    """Return the arm that poses (N, 4, 4) and joints (N, J) [rad] prove, None where they do not."""
    known = known_chains(joints.shape[1])
    arms = [known[key].bare() for key in sorted(known, key=lambda k: not same_name(k, name))]
    return matching_arm(joints, Ts_base_ee, arms)


def write_results(
    report: HandEyeReport, seen: Sequence[BoardView], store: SessionFiles,
    views_store: SessionStore, console: Console,
) -> None:  # fmt: skip
    """Write report, pictures, depth bias and the files for other tools into the session."""
    from realsim_calibration.exports.frames import FrameNames
    from realsim_calibration.exports.write import write_exports
    from realsim_calibration.report.page import PAGE_NAME, write_calibration_report

    folder = store.folder / RESULTS
    (folder / "report" / PAGE_NAME).unlink(missing_ok=True)  # written last: not whole without it
    used = {v.index for v in report.used}
    views = [
        DepthBoardView(
            index=v.index, depth_m=views_store.depth_m(v.index), detection=v.detection, name=v.label
        )
        for v in seen
        if v.index in used
    ]
    depth = note_depth_bias(store, views, report)
    write_exports(report, folder / "exports", frames=FrameNames(), tell=console.warn)
    write_calibration_report(report, folder / "report", images=views_store.rgb, depth_report=depth)


def note_depth_bias(
    store: SessionFiles, views: Sequence[DepthBoardView], report: HandEyeReport
) -> DepthBiasReport | None:
    """Return the depth camera's bias and note it in the session; None where it cannot be told."""
    try:
        found = estimate_depth_bias(
            views, report.target, report.intrinsics, shape=report.board,
            intrinsics_covariance=report.intrinsics_covariance,
        )  # fmt: skip
    except RealsimError as error:
        store.write_json(DEPTH_FILE, {"known": False, "why": str(error)})
        return None
    store.write_json(DEPTH_FILE, {"known": True, **depth_bias_to_json(found)})
    return found


def depth_bias_to_json(found: DepthBiasReport) -> dict[str, Any]:
    """Return a depth bias as JSON values: a prior for the registration, and its checks."""
    bias = found.bias
    return {
        "model": "1 / z_true = scale / z_measured + offset_per_m",
        "scale": bias.scale,
        "offset_per_m": bias.offset_per_m,
        "covariance": bias.covariance.tolist(),
        "noise_per_m": to_json(bias.noise_per_m),
        "range_m": [to_json(v) for v in bias.range_m],
        "separable": bias.separable,
        "checks": [to_json(check) for check in found.checks],
    }


SEARCH = "4"
"""Goes up when a search finds or says something else: notes of an earlier search are void."""
LOOKED_AT = 2
"""Images without the target in which it is looked what they show, which takes a second each."""


def find_in_images(
    images: Sequence[Path], target: Target, out: Path, console: Console
) -> list[TargetDetection]:
    """Return the points found in every image; what was found before is not looked for again.

    Images are searched side by side, as many as there are cores: OpenCV and numpy let go of the
    interpreter while they work.
    """
    from realsim_calibration.inputs.image_files import require_readable
    from realsim_calibration.targets.target_text import format_target

    what = f"{format_target(target)} {SEARCH}".encode()
    with console.stage("find the target", f"{len(images)} images") as tick:
        found: list[TargetDetection] = []
        with ThreadPoolExecutor(cores()) as pool:
            search = [pool.submit(_found_once, path, target, what, out) for path in images]
            try:
                for k, one in enumerate(search):
                    note, seen, is_new = one.result()
                    if is_new:  # by one thread: equal images have one note
                        write_json(note, to_json(seen))
                    found.append(seen)
                    tick(k + 1, len(images))
            except BaseException as error:
                pool.shutdown(cancel_futures=True)  # one bad image: the others are not waited for
                if isinstance(error, InputError):
                    require_readable(images)
                raise
    return found


def _found_once(
    path: Path, target: Target, what: bytes, out: Path
) -> tuple[Path, TargetDetection, bool]:
    """Return the points in one image, from its note or by a search; the note, whether it is new."""
    from realsim_calibration.inputs.image_files import load_image

    note = out / "detections" / f"{hashlib.sha256(path.read_bytes() + what).hexdigest()[:24]}.json"
    seen = _noted(note)
    if seen is not None:
        return note, seen, False
    return note, find_target(load_image(path), target), True


def warn_of_pictures(
    folder: "FolderInput", detections: Sequence[TargetDetection], target: Target, console: Console
) -> None:
    """Say which images have drawings on the target, and which show another target."""
    from realsim_calibration.detect.find import BLURRED
    from realsim_calibration.detect.visible import COVERED, DRAWN, what_is_visible
    from realsim_calibration.inputs.image_files import load_image

    drawn = [
        k
        for k, d in enumerate(detections)
        if any(r.startswith((DRAWN, COVERED)) for r in d.rejected)
    ]
    if drawn:
        why = detections[drawn[0]].rejected[0]
        console.warn(f"{_named(folder, drawn)}: {why}, or leave these images out.")
    lost = [k for k, d in enumerate(detections) if not len(d)]
    sharp = [k for k in lost if not any(r.startswith(BLURRED) for r in detections[k].rejected)]
    for k in sharp[:LOOKED_AT]:
        shown = what_is_visible(load_image(folder.images[k]))
        if _is_other(shown, target):
            console.warn(
                f"{folder.labels[k]} shows {shown}, not the target; it is one of {len(lost)} "
                f"images without it ({_named(folder, lost)}). Are two boards mixed? Keep one a "
                "calibration: move the images of the other into a folder of their own."
            )
            return


def _named(folder: "FolderInput", rows: Sequence[int]) -> str:
    more = f" and {len(rows) - 8} more" if len(rows) > 8 else ""
    return ", ".join(folder.labels[k] for k in rows[:8]) + more


def _is_other(shown: str, target: Target) -> bool:
    """Return whether what a picture shows is another kind of target than this one."""
    markers, dots = "markers of" in shown, "dots" in shown
    if not (markers or dots or "chessboard" in shown):
        return False
    if isinstance(target, CircleGrid):
        return not dots
    if isinstance(target, Chessboard):
        return markers or dots
    family = target.dictionary if isinstance(target, CharucoBoard) else "APRILTAG"
    return not markers or family.split("_")[1 if family.startswith("DICT_") else 0] not in shown


def require_views(folder: "FolderInput", detections: Sequence[TargetDetection], least: int) -> None:
    """Raise unless the target was found in enough images, with the reasons of the others.

    Raises:
        InputError: too few; says how many are needed.
    """
    found = sum(len(d) > 0 for d in detections)
    if found >= least:
        return
    why = "; ".join(
        f"{n}: {d.rejected[0] if d.rejected else 'the target was not found'}"
        for n, d in zip(folder.labels, detections, strict=True)
        if not len(d)
    )
    raise InputError(
        f"{found} of {len(detections)} images show the target. A hand-eye needs {least} views at "
        "least, and 24 are advised: tilted about two axes, rolled about the camera's axis, from "
        f"several distances.{' Not found in ' + why + '.' if why else ''}"
    )


def _noted(path: Path) -> TargetDetection | None:
    """Return a detection noted earlier; a damaged note is no note."""
    try:
        return read_own(path, TargetDetection)
    except InputError:
        return None


def require_target(
    folder: "FolderInput", detections: Sequence[TargetDetection], target: Target
) -> None:
    """Raise if the target was found nowhere, saying what is wrong with the pictures.

    Raises:
        InputError: found nowhere; says whether the first picture is too dark or blurred, or what it
            shows instead.
    """
    if any(len(d) for d in detections):
        return
    from realsim_calibration.targets.target_text import format_target

    raise InputError(
        f"the target '{format_target(target)}' was found in none of the {len(detections)} images. "
        + why_not_found(folder.images[0], folder.labels[0])
    )


def why_not_found(path: Path, name: str) -> str:
    """Return what is wrong with an image in which no target was found, in sentences.

    It is too dark, drawn over or blurred, or it shows something else.
    """
    from realsim_calibration.detect.find import blur_reason
    from realsim_calibration.detect.images import gray_image
    from realsim_calibration.detect.visible import dark_reason, drawing_reason, what_is_visible
    from realsim_calibration.inputs.image_files import load_image

    image = load_image(path)
    spoiled = dark_reason(image) or drawing_reason(image, np.zeros((0, 2)))
    if spoiled:
        return f"{name}: {spoiled}."
    shown, blurred = what_is_visible(image), blur_reason(gray_image(image))
    if blurred:
        return (
            f"{name}: {blurred}. Then take the pictures again. As blurred as it is, it "
            f"seems to show {shown}: only if the target is another than given, change --board."
        )
    return f"{name} shows {shown}. Give --board as it was printed."


def require_one_size(
    labels: Sequence[str],
    detections: Sequence[TargetDetection],
    camera: CameraIntrinsics | None,
    file: Path | None,
) -> None:
    """Raise unless all images have one size, and the given camera the same.

    It is asked before the poses are looked at: a lens of another size spoils every board pose, and
    the poses would be blamed.

    Raises:
        InputError: several sizes; says which, and by how much the intrinsics are to be scaled.
    """
    sizes = Counter(d.image_size for d in detections)
    (w, h), _ = sizes.most_common(1)[0]
    if len(sizes) > 1:
        odd = [n for n, d in zip(labels, detections, strict=True) if d.image_size != (w, h)]
        shown = ", ".join(f"{n} of {a}x{b} px" for (a, b), n in sizes.most_common())
        raise InputError(
            f"the images have several sizes: {shown}. One lens belongs to one size: take these "
            f"out: {', '.join(odd[:8])}{' ...' if len(odd) > 8 else ''}."
        )
    if camera is None or (camera.width, camera.height) == (w, h):
        return
    same_shape = camera.width * h == camera.height * w
    scale = (
        f"if the images were only resized: fx and fy times s = {w / camera.width:.4g}, cx and cy "
        "as (c + 0.5) * s - 0.5"
        if same_shape
        else "their shapes differ: a crop or another mode of the sensor"
    )
    raise InputError(
        f"--intrinsics {file} is for images of {camera.width}x{camera.height} px, and these are "
        f"{w}x{h}. Give the intrinsics of this size ({scale}), or leave --intrinsics out: the lens "
        "is then calibrated from these images."
    )
