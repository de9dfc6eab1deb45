"""The target in the images of a folder: found once and noted, and refused where it is nowhere."""

import hashlib
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from realsim.app.console import Console
from realsim.errors import InputError
from realsim.interop import cores
from realsim.records import CameraIntrinsics, Target
from realsim.records.targets import CharucoBoard, Chessboard, CircleGrid
from realsim.store.atomic import write_json
from realsim.untrusted.own_json import read_own, to_json
from realsim_calibration import TargetDetection, find_target

if TYPE_CHECKING:
    from realsim_calibration.inputs.folder import FolderInput

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
    from realsim_calibration.detect.drawings import COVERED, DRAWN
    from realsim_calibration.detect.find import BLURRED
    from realsim_calibration.detect.visible import what_is_visible
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
    from realsim_calibration.detect.drawings import drawing_reason
    from realsim_calibration.detect.find import blur_reason
    from realsim_calibration.detect.images import gray_image
    from realsim_calibration.detect.visible import dark_reason, what_is_visible
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
