"""nerfstudio's transforms.json: its cameras and frames, and ours.

nerfstudio shoots the ray of pixel (0, 0) through (0.5, 0.5), as COLMAP does, so cx and cy are half
a pixel more than OpenCV's. Its lens is

    d = 1 + k1 r + k2 r^2 + k3 r^3 + k4 r^4 with r = x^2 + y^2, and OpenCV's p1, p2:

k1 k2 p1 p2 k3 are OpenCV's; its k4 is NOT OpenCV's k4, which divides. Cameras look along -z with y
up (OpenGL), `transform_matrix` is camera to world, and `applied_transform` (3, 4) and
`applied_scale` say what was done to the original world before it was written:
p_file = applied_scale * (applied_transform @ p_original).
Sources: nerfstudio's data conventions, its camera_utils and nerfstudio_dataparser.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from realsim import interop
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.folders.listing import ENDINGS, image_header, natural_key, shown
from realsim.formats.folders.posed_images import PosedImage
from realsim.formats.frame_source import require_plausible
from realsim.geometry import se3
from realsim.records import CameraIntrinsics
from realsim.untrusted import json_text, values

LENS = ("k1", "k2", "p1", "p2", "k3")
"""Coefficients that nerfstudio and OpenCV share, in OpenCV's order."""
CAMERA_KEYS = (
    "fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2",
    "camera_angle_x", "camera_angle_y", "x_fov", "y_fov", "camera_model", "is_fisheye",
)  # fmt: skip
"""Keys that say something of the camera, at the top or in a frame."""
PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
"""nerfstudio's names of cameras that the record has a place for."""
STRANGE = (
    "ftheta_p0", "latlong", "equirectangular", "rolling_shutter", "from_na", "normal_mts_args",
)  # fmt: skip
"""Keys of instant-ngp and its relatives by which the camera or its pose is another."""
SAME_FOCAL = 5e-3
"""Share by which a focal length and an angle of view of the same file may differ."""


# --- intrinsics -------------------------------------------------------------------------------


def intrinsics_of(
    top: Mapping[str, Any], frame: Mapping[str, Any], size: tuple[int, int], where: str
) -> CameraIntrinsics:
    """Return the camera of a frame.

    Args:
        top: the whole document.
        frame: the frame's own entry.
        size: (width, height) [px] of its image.
        where: for messages.

    Raises:
        InputError: a lens without a place in the record, values that contradict one another or the
            image, or no focal length.
    """
    said = {k: _stated(top, frame, k, where) for k in CAMERA_KEYS}
    found = {k: v for k, v in said.items() if v is not None}
    _require_pinhole(top, frame, found, where)
    width, height = size
    for key, have in (("w", width), ("h", height)):
        if key in found and values.whole(found[key], f"'{key}' of {where}", 1, 1e6) != have:
            raise InputError(
                f"{where}: the camera is of {found.get('w')}x{found.get('h')} px, the image of "
                f"{width}x{height} px. Give the images that the file was made for; a downscaled "
                "copy has another camera."
            )
    fx = _focal(found, "x", width, where)
    fy = _focal(found, "y", height, where)
    if fx is None:
        raise InputError(
            f"{where}: no focal length: fl_x, camera_angle_x or x_fov is expected in the file or "
            "in its frames."
        )
    at = [
        values.number(found.get(key, side / 2), f"'{key}' of {where}")
        for key, side in (("cx", width), ("cy", height))
    ]
    cx, cy = (float(v) for v in interop.opencv_from_colmap_px(at))
    camera = CameraIntrinsics(
        width=width, height=height, fx=fx, fy=fx if fy is None else fy, cx=cx, cy=cy,
        distortion=np.array([values.number(found.get(k, 0.0), f"'{k}' of {where}") for k in LENS]),
    )  # fmt: skip
    require_plausible(camera, where)
    return camera


def _stated(top: Mapping[str, Any], frame: Mapping[str, Any], key: str, where: str) -> Any:
    """Return a value of the frame or of the whole file, None where neither has it."""
    if key in top and key in frame and top[key] != frame[key]:
        raise InputError(
            f"{where}: '{key}' is {top[key]!r:.40} for the whole file and {frame[key]!r:.40} in "
            "the frame; nerfstudio takes the first, instant-ngp the second. Remove the wrong one."
        )
    return frame.get(key, top.get(key))


def _require_pinhole(
    top: Mapping[str, Any], frame: Mapping[str, Any], found: Mapping[str, Any], where: str
) -> None:
    model = found.get("camera_model", "OPENCV")
    if model not in PINHOLES or found.get("is_fisheye"):
        name = "a fisheye" if found.get("is_fisheye") else repr(model)[:60]
        raise InputError(
            f"{where}: the camera model is {name}, which the record has no place for; "
            f"{', '.join(PINHOLES)} have. Undistort the images to a pinhole first."
        )
    strange = [k for k in STRANGE if top.get(k) or frame.get(k)]
    if strange:
        raise InputError(
            f"{where}: '{strange[0]}' is set, by which camera or axes are others than "
            "nerfstudio's; such files are not read."
        )
    if values.number(found.get("k4", 0.0), f"'k4' of {where}") != 0:
        raise InputError(
            f"{where}: k4 is {found['k4']}: in nerfstudio the coefficient of r^8, which OpenCV's "
            "model and the record do not have (OpenCV's k4 divides). Undistort the images, or "
            "calibrate with k1 k2 p1 p2 k3."
        )


def _focal(found: Mapping[str, Any], axis: str, side: int, where: str) -> float | None:
    """Return the focal length [px] of an axis, None where nothing says it."""
    told: list[tuple[str, float]] = []
    if f"fl_{axis}" in found:
        key = f"fl_{axis}"
        told.append((key, values.number(found[key], f"'{key}' of {where}", 1e-9, 1e9)))
    for key, full_turn in ((f"camera_angle_{axis}", 2 * math.pi), (f"{axis}_fov", 360.0)):
        if key in found:
            angle = values.number(found[key], f"'{key}' of {where}", 1e-6, 0.4999 * full_turn)
            told.append((key, 0.5 * side / math.tan(math.pi * angle / full_turn)))
    for key, f in told[1:]:
        if abs(f / told[0][1] - 1) > SAME_FOCAL:
            raise InputError(
                f"{where}: {told[0][0]} means a focal length of {told[0][1]:.2f} px, {key} one of "
                f"{f:.2f} px. Remove the wrong one."
            )
    return told[0][1] if told else None


def camera_entry(camera: CameraIntrinsics, where: str) -> dict[str, Any]:
    """Return the keys of a camera for transforms.json.

    Raises:
        InputError: the lens divides (k4, k5, k6), for which nerfstudio has no place.
    """
    d = [float(v) for v in camera.distortion]
    if any(d[5:]):
        raise InputError(
            f"{where}: the lens has the rational terms k4 {d[5]:g}, k5 {d[6]:g}, k6 {d[7]:g}, and "
            "nerfstudio's model has no place for them (its k4 is another). Export as COLMAP, whose "
            "FULL_OPENCV has, or calibrate with k1 k2 p1 p2 k3."
        )
    cx, cy = (float(v) for v in interop.colmap_from_opencv_px([camera.cx, camera.cy]))
    return {
        "w": camera.width, "h": camera.height, "fl_x": float(camera.fx), "fl_y": float(camera.fy),
        "cx": cx, "cy": cy, **dict(zip(LENS, d, strict=False)),
    }  # fmt: skip


# --- poses ------------------------------------------------------------------------------------


def transform_matrix(T_world_cam: ArrayLike) -> list[list[float]]:
    """Return the rows of `transform_matrix` of a pose (4, 4)."""
    rows: list[list[float]] = interop.T_world_gl_from_cam(T_world_cam).tolist()
    return rows


def T_world_cam_of(matrix: Any, where: str) -> Array:
    """Return T_world_cam (4, 4) in the file's world and unit.

    Raises:
        InputError: it is no 4x4 (or 3x4) matrix, or not rigid.
    """
    return interop.T_world_cam_from_gl(se3.check_rigid(_matrix(matrix, where), where))


def _matrix(value: Any, where: str) -> Array:
    """Return a (4, 4) of rows of numbers; the last row 0 0 0 1 may be left out."""
    rows = cast("list[Any]", value) if isinstance(value, list) else []
    if len(rows) not in (3, 4):
        raise InputError(f"{where} is no matrix of 4x4 (or 3x4) numbers.")
    M = np.eye(4)
    for k, row in enumerate(rows):
        M[k] = values.numbers(row, 4, f"row {k + 1} of {where}")
    if not np.array_equal(M[3], [0, 0, 0, 1]):
        raise InputError(f"{where} has the last row {M[3].tolist()}; 0 0 0 1 is expected.")
    return M


def undone(top: Mapping[str, Any], where: str) -> tuple[Array, float, list[str]]:
    """Return what brings the file's world back to the original one, and notes.

    Returns:
        T_original_file (4, 4) without scale, factor of the translations before it, and notes.

    Raises:
        InputError: `applied_transform` is not rigid, or `applied_scale` not positive.
    """
    notes: list[str] = []
    T, factor = np.eye(4), 1.0
    if "applied_scale" in top:
        name = f"'applied_scale' of {where}"
        factor = 1.0 / values.number(top["applied_scale"], name, 1e-9, 1e9)
    if "applied_transform" in top:
        M = _matrix(top["applied_transform"], f"'applied_transform' of {where}")
        T = se3.invert(se3.check_rigid(M, f"'applied_transform' of {where}"))
    if factor != 1.0:
        notes.append(f"applied_scale {1 / factor:g} was undone.")
    if not np.array_equal(T, np.eye(4)):
        notes.append("applied_transform was undone: poses are in the world before it.")
    return T, factor, notes


FILE = "transforms.json"
MOST_FRAMES = 200_000
"""Frames in one file; more are a whole data set."""
DEFAULT_DEPTH_UNIT_M = 1e-3
"""nerfstudio's own --depth-unit-scale-factor where nobody says another."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Transforms:
    """What a transforms.json says."""

    path: Path
    frames: tuple[PosedImage, ...]
    """Those whose images are there, in natural order of their names; poses are in the original
    world, in the file's unit before `applied_scale`."""
    depth_unit: float
    """Units of the file's world per count of depth."""
    depth_unit_said: str
    """Who says so: a key of the file, or ''."""
    notes: tuple[str, ...]


def find_transforms(root: Path | str) -> Path | None:
    """Return the transforms.json of a folder, or the file itself; None where there is none."""
    root = Path(root)
    if root.is_file():
        return (
            root if root.suffix.lower() == ".json" and root.stem.startswith("transforms") else None
        )
    return root / FILE if (root / FILE).is_file() else None


def read_transforms(path: Path | str, *, images_folder: Path | None = None) -> Transforms:
    """Return the frames of a transforms.json.

    Args:
        path: the file.
        images_folder: where images of these names are, instead of where the file says.

    Raises:
        InputError: damaged, a camera or pose that cannot be, two frames of one image, or no image
            is there.
    """
    path = Path(path)
    top = values.mapping(json_text.read_json(path), str(path))
    entries = top.get("frames")
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path} has no list of 'frames'; is it a transforms.json?")
    rows = cast("list[Any]", entries)
    if len(rows) > MOST_FRAMES:
        raise InputError(f"{path} has {len(rows)} frames; at most {MOST_FRAMES} are one scene.")
    T_original_file, factor, notes = undone(top, str(path))
    frames: list[PosedImage] = []
    absent: list[str] = []
    seen: set[Path] = set()
    for k, row in enumerate(rows):
        where = f"frame {k + 1} of {path}"
        entry = values.mapping(row, where)
        name = values.text(entry.get("file_path"), f"'file_path' of {where}")
        T = T_world_cam_of(entry.get("transform_matrix"), f"'transform_matrix' of {where}")
        T[:3, 3] *= factor
        colour = _image_file(path.parent, name, images_folder, where)
        if (image := colour or Path(name)) in seen:
            raise InputError(f"{path} has two frames of the image {image}: which pose is its own?")
        seen.add(image)
        if colour is None:
            absent.append(name)
            continue
        frames.append(
            PosedImage(
                name=name, colour=colour, depth=_depth_file(path.parent, entry, where),
                intrinsics=intrinsics_of(top, entry, image_header(colour).size, where),
                T_world_cam=T_original_file @ T,
            )
        )  # fmt: skip
    if not frames:
        raise InputError(
            f"none of the {len(rows)} images of {path} was found ({shown(absent, 3)}). Give the "
            "folder that they are in with --images."
        )
    if absent:
        notes.append(f"{len(absent)} images are not there and were left out: {shown(absent)}.")
    notes += _other_notes(top, rows)
    frames.sort(key=lambda f: natural_key(f.name))
    unit, said = _depth_unit(top, path)
    return Transforms(
        path=path, frames=tuple(frames), depth_unit=unit * (1.0 if said != NGP_UNIT else factor),
        depth_unit_said=said, notes=tuple(notes),
    )  # fmt: skip


def _image_file(folder: Path, name: str, images_folder: Path | None, where: str) -> Path | None:
    """Return the image that a frame names; NeRF's own files leave the ending out."""
    said = f"'file_path' of {where}"
    if images_folder is not None:
        base = PurePosixPath(name.replace("\\", "/")).name
        path = images_folder / values.relative_path(base, said)
    else:
        path = values.path_inside(folder, name, said)
    if path.is_file():
        return path
    if path.suffix.lower() in ENDINGS:
        return None
    beside = (path.with_name(path.name + ending) for ending in ENDINGS)
    return next((p for p in beside if p.is_file()), None)


def _depth_file(folder: Path, entry: Mapping[str, Any], where: str) -> Path | None:
    """Return the depth image that a frame names, None where it names none or it is not there."""
    for key in ("depth_file_path", "depth_path"):
        if entry.get(key) is not None:
            path = values.path_inside(folder, entry[key], f"'{key}' of {where}")
            return path if path.is_file() else None
    return None


UNIT, NGP_UNIT = "depth_unit_scale_factor", "integer_depth_scale"


def _depth_unit(top: Mapping[str, Any], path: Path) -> tuple[float, str]:
    """Return units per count of depth, and the key that says so ('' = nerfstudio's default)."""
    for key in (UNIT, NGP_UNIT):
        if key in top:
            return values.number(top[key], f"'{key}' of {path}", 1e-9, 1e3), key
    return DEFAULT_DEPTH_UNIT_M, ""


def _other_notes(top: Mapping[str, Any], rows: Sequence[Any]) -> list[str]:
    """Return notes on what the file has and is not used."""
    notes: list[str] = []
    boxed = [k for k in ("aabb_scale", "scale", "offset") if k in top]
    if boxed:
        notes.append(
            f"{', '.join(boxed)} of instant-ngp say how it places the scene in its box when it "
            "loads; the poses in the file are before that, and were taken as they stand."
        )
    masks = sum(isinstance(row, dict) and "mask_path" in row for row in rows)
    if masks:
        notes.append(f"{masks} masks of the training were left aside.")
    return notes
