"""Intrinsics from files, the factory's or other tools', and back.

| format | recognised by | written |
|---|---|---|
| realsim | json with fx fy cx cy distortion | yes |
| ros | YAML with camera_matrix and distortion_model (camera_info) | yes |
| opencv | FileStorage YAML, XML or JSON with a camera matrix | yes (YAML) |
| matrix | json with `intrinsic` or `K`, `distortion`, `resolution` | |
| mapping | fx fy cx cy (or ppx ppy) by name under `intrinsics` or `K` | |
| bop | json with fx fy cx cy depth_scale | |
| realsense | json with fx fy ppx ppy coeffs | |
| colmap | cameras.txt | |
| visp | XML with camera, model, px py u0 v0 (camera.xml) | |

COLMAP counts pixels from the image's corner, everybody else here from the first pixel's centre.
What a file does not say (the image size) or what has no place in the record (a fisheye, skew) is an
error: a guess would be a wrong calibration.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from realsim.arrays import Array
from realsim.errors import InputError
from realsim.interop import opencv_from_colmap_px
from realsim.records import CameraIntrinsics
from realsim.untrusted.own_json import from_json, to_json
from realsim_calibration.lens.camera_file_syntax import Fields, first_line, named_values, read_text

Format = Literal["realsim", "ros", "opencv"]
SMALLEST_SIDE = 8
"""An image this small is no image [px]."""
CENTRE_SHARE = 0.15
"""A principal point farther from the image's centre than this share of its size is of another
resolution: a matrix alone does not say for which size of image it holds. A matrix of half the
resolution is 0.25 off, of two thirds 0.17; lenses stay within 0.1."""
ASPECT_RANGE = (0.5, 2.0)
"""fx / fy beyond this is no lens: pixels are square, or nearly, even in squeezed video."""
MATRIX_KEYS = (
    "camera_matrix", "cameraMatrix", "Camera_Matrix", "CameraMatrix", "intrinsic_matrix",
    "intrinsic", "intrinsics", "camMatrix", "mtx", "K", "M", "M1", "K1", "k",
)  # fmt: skip
CAMERA_KEYS = (*MATRIX_KEYS, "fx")
"""Keys that only a camera has."""
DISTORTION_KEYS = (
    "distortion_coefficients", "dist_coeffs", "distCoeffs", "Distortion_Coefficients",
    "dist_coeff", "distortion", "distCoeff", "distortion_coeffs", "dist", "coeffs", "D", "D1", "d",
)  # fmt: skip
WIDTH_KEYS = ("image_width", "width", "Width", "imageWidth", "image_Width", "w")
HEIGHT_KEYS = ("image_height", "height", "Height", "imageHeight", "image_Height", "h")
SIZE_KEYS = ("resolution", "image_size", "imageSize", "img_size", "size", "image_Size")
ROS_MODELS = {"plumb_bob": 5, "radtan": 4, "rational_polynomial": 8, "none": 0, "": 0}
"""Distortion models of ROS and Kalibr that are OpenCV's, and their coefficients (0 = any)."""
REALSENSE_MODELS = ("", "none", "brown_conrady", "distortion.none", "distortion.brown_conrady")
"""librealsense's models that are OpenCV's. Its inverse model is another one unless all zero."""
FOREIGN_MODELS = (
    "fisheye", "kannala", "equidistant", "inverse", "ftheta", "mei", "omni", "fov", "division",
    "double_sphere", "eucm",
)  # fmt: skip
"""Words that name lens models which the record has no place for."""
COLMAP_MODELS: dict[str, int] = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8,
    "FULL_OPENCV": 12,
}  # fmt: skip
"""COLMAP's camera models that the record holds, and their parameters."""


def read_camera(path: Path | str, *, size: tuple[int, int] | None = None) -> CameraIntrinsics:
    """Return the intrinsics in a file, whatever its format of those in the table above.

    Args:
        path: the file.
        size: (width, height) [px] of the images, for a file that does not say it. The principal
            point must lie near their centre then; what the file says counts more.

    Raises:
        InputError: there is no such file, it is too large or damaged, it holds no camera, several,
            one of a lens model that the record has no place for, or no image size.
    """
    path = Path(path)
    text = read_text(path)
    if path.name == "cameras.txt" or text.lstrip().startswith("# Camera list"):
        return _checked(_colmap(text, path), path)
    fields = named_values(text, path, CAMERA_KEYS)
    try:
        camera = _camera(fields, path, size)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"the camera file {path} is damaged: {first_line(error)}") from error
    return _checked(camera, path)


# --- meaning ----------------------------------------------------------------------------------


def _first(fields: Fields, keys: tuple[str, ...]) -> Any:
    return next((fields[key] for key in keys if key in fields), None)


def _numbers(value: Any, name: str, path: Path) -> Array:
    value = value.get("data") if isinstance(value, Mapping) else value
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: {name} is {value!r}; numbers are expected.") from error
    if not np.all(np.isfinite(numbers)):
        raise InputError(f"{path}: {name} holds a value that is not a finite number.")
    return numbers


def _size(fields: Fields, path: Path) -> tuple[int, int]:
    """Return width and height.

    Raises:
        InputError: the file does not say them.
    """
    width, height = _first(fields, WIDTH_KEYS), _first(fields, HEIGHT_KEYS)
    if width is None or height is None:
        pair = _first(fields, SIZE_KEYS)
        if isinstance(pair, Mapping):
            return _size({str(k): v for k, v in pair.items()}, path)
        if pair is None or np.size(pair) != 2:
            raise InputError(
                f"{path} does not say how large its images are, and a focal length in pixels means "
                "nothing without it. Add image_width and image_height. It holds: "
                f"{', '.join(list(fields)[:12])}."
            )
        width, height = np.ravel(pair)
    w, h = (float(_numbers(v, "the image size", path)) for v in (width, height))
    if not (w.is_integer() and h.is_integer() and min(w, h) >= SMALLEST_SIDE):
        raise InputError(f"{path}: the image size {w:g}x{h:g} is not one of an image.")
    return int(w), int(h)


def _matrix(value: Any, path: Path) -> Array:
    """Return the (3, 3) camera matrix of nested or flat numbers, or of fx fy cx cy.

    Raises:
        InputError: it is none.
    """
    K = _numbers(value, "the camera matrix", path)
    if K.size == 4:
        fx, fy, cx, cy = K.ravel()
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    if K.size != 9:
        raise InputError(f"{path}: the camera matrix has {K.size} numbers, not 9.")
    K = K.reshape(3, 3)
    if K[0, 2] == 0 and K[1, 2] == 0 and (K[2, 0] != 0 or K[2, 1] != 0):
        raise InputError(
            f"{path}: the camera matrix is stored transposed (Matlab's convention, which also "
            "counts pixels from 1); export it as [[fx 0 cx] [0 fy cy] [0 0 1]]."
        )
    return K


def _distortion(fields: Fields, path: Path) -> Array:
    """Return OpenCV's distortion coefficients; none where the file has none.

    Raises:
        InputError: they belong to a lens model that the record has no place for.
    """
    value = _first(fields, DISTORTION_KEYS)
    numbers = np.zeros(0) if value is None else _numbers(value, "the distortion", path).ravel()
    undistorted = not np.any(numbers != 0)
    model = str(fields.get("distortion_model", "")).strip().lower()
    known = model in ROS_MODELS or model in REALSENSE_MODELS
    for other in (str(fields.get(key, "")).lower() for key in ("model", "camera_model")):
        # These keys may name the camera's make as well.
        if any(word in other for word in FOREIGN_MODELS):
            model, known = other, False
    if not known and not undistorted:
        raise InputError(
            f"{path}: the distortion model '{model}' is not one of OpenCV's Brown (plumb_bob) or "
            "rational model; others (kannala_brandt, equidistant, fisheye, inverse_brown_conrady) "
            "cannot be converted exactly. Calibrate with the target, or undistort the images."
        )
    if not known:
        return np.zeros(0)
    most = ROS_MODELS.get(model, 0)
    if most and len(numbers) > most and np.any(numbers[most:] != 0):
        raise InputError(
            f"{path}: {len(numbers)} coefficients for the model '{model}', which has {most}."
        )
    return numbers


def _size_or(fields: Fields, path: Path, size: tuple[int, int] | None, K: Array) -> tuple[int, int]:
    """Return the image size that the file says, else the images' own if K fits it.

    Raises:
        InputError: neither is known, or K is of images of another size.
    """
    stated = any(key in fields for key in (*WIDTH_KEYS, *HEIGHT_KEYS, *SIZE_KEYS))
    if stated or size is None:
        return _size(fields, path)
    require_centred(K, size, path)
    return size


def require_centred(K: Array, size: tuple[int, int], path: Path) -> None:
    """Refuse a matrix (3, 3) [px] whose principal point is far from the centre of (width, height).

    Raises:
        InputError: it is of another image size.
    """
    if max(abs(K[k, 2] - size[k] / 2) / size[k] for k in (0, 1)) > CENTRE_SHARE:
        raise InputError(
            f"{path}: the principal point ({K[0, 2]:.1f}, {K[1, 2]:.1f}) is far from the centre of "
            f"the images ({size[0]}x{size[1]} px): the matrix is of another image size. Give the "
            "camera of these images."
        )


def _camera(fields: Fields, path: Path, size: tuple[int, int] | None = None) -> CameraIntrinsics:
    """Return the camera of named values.

    Raises:
        InputError: they are none.
    """
    if "fisheye" in fields and fields["fisheye"] not in (False, 0, "false"):
        raise InputError(f"{path} describes a fisheye lens, which realsim does not support.")
    own = ("width", "height", "fx", "fy", "cx", "cy", "distortion")
    if set(own) <= set(fields):
        return from_json({k: fields[k] for k in own}, CameraIntrinsics, f"the camera file {path}")
    if {"fx", "fy"} <= set(fields):
        center = [_first(fields, keys) for keys in (("cx", "ppx"), ("cy", "ppy"))]
        if None in center:
            raise InputError(
                f"{path} has fx and fy but no principal point (cx and cy, or ppx and ppy)."
            )
        values = [fields["fx"], fields["fy"], *center]
        K = _matrix([float(_numbers(v, "fx fy cx cy", path)) for v in values], path)
    else:
        value = _first(fields, MATRIX_KEYS)
        if value is None:
            raise InputError(
                f"{path} holds no camera: neither a camera matrix ({', '.join(MATRIX_KEYS[:3])}, "
                f"...) nor fx and fy. It holds: {', '.join(list(fields)[:12]) or 'nothing'}."
            )
        if isinstance(value, Mapping) and "data" not in value:
            # fx fy cx cy by name; what stands beside them (size, distortion) belongs to them.
            beside = {k: v for k, v in fields.items() if k not in MATRIX_KEYS}
            named = {str(k): v for k, v in value.items()}
            if not {"fx", "fy"} <= set(named):
                raise InputError(
                    f"{path}: the camera matrix is given by name, and fx and fy are not among the "
                    f"names: {', '.join(list(named)[:12])}."
                )
            return _camera(beside | named, path, size)
        K = _matrix(value, path)
    width, height = _size_or(fields, path, size, K)
    return CameraIntrinsics.from_K(K, width, height, _distortion(fields, path))


def _colmap(text: str, path: Path) -> CameraIntrinsics:
    """Return the camera of COLMAP's cameras.txt.

    Raises:
        InputError: there is not exactly one, or its model has no place in the record.
    """
    lines = [line.split() for line in text.splitlines() if line.strip() and line[0] != "#"]
    if len(lines) != 1:
        raise InputError(
            f"{path} holds {len(lines)} cameras; one is expected. Leave the line of one camera in."
        )
    words = lines[0]
    model = words[1] if len(words) > 1 else ""
    if model not in COLMAP_MODELS:
        raise InputError(
            f"{path}: the camera model '{model}' is not supported; accepted: "
            f"{', '.join(COLMAP_MODELS)}."
        )
    try:
        width, height = int(words[2]), int(words[3])
        p = [float(word) for word in words[4:]]
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: '{' '.join(words)}' is not a line of cameras.txt.") from error
    if len(p) != COLMAP_MODELS[model]:
        raise InputError(
            f"{path}: the model {model} has {COLMAP_MODELS[model]} parameters, found {len(p)}."
        )
    single = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
    fx, fy = (p[0], p[0]) if single else (p[0], p[1])
    rest = p[1:] if single else p[2:]
    cx, cy = (float(v) for v in opencv_from_colmap_px(rest[:2]))
    return CameraIntrinsics(
        width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=np.array(rest[2:])
    )


def _checked(camera: CameraIntrinsics, path: Path) -> CameraIntrinsics:
    """Return the camera if it can be one.

    Raises:
        InputError: its focal lengths are those of no lens.
    """
    ratio = camera.fx / camera.fy
    low, high = ASPECT_RANGE
    copied = camera.fx == camera.cx and camera.fy == camera.cy
    if copied or not low <= ratio <= high:
        why = " fx and fy repeat the principal point: they were written from it." if copied else ""
        raise InputError(
            f"{path}: fx = {camera.fx:g} and fy = {camera.fy:g} px (ratio {ratio:.2f}) are those "
            f"of no camera.{why} Take the intrinsics from the camera itself."
        )
    if not (0 <= camera.cx <= camera.width and 0 <= camera.cy <= camera.height):
        raise InputError(
            f"{path}: the principal point ({camera.cx:g}, {camera.cy:g}) lies outside the image of "
            f"{camera.width}x{camera.height} px. Do matrix and image size belong together?"
        )
    return camera


# --- writing ----------------------------------------------------------------------------------


def write_camera(
    path: Path | str, intrinsics: CameraIntrinsics, *, format: Format, name: str = "camera"
) -> None:
    """Write intrinsics whole or not at all; `read_camera` gives back the same bits.

    Args:
        path: the file.
        intrinsics: the camera.
        format: "realsim" (JSON), "ros" (camera_info YAML) or "opencv" (FileStorage YAML).
        name: the camera's name, which ROS wants.

    Raises:
        InputError: the format is none of these, or the name is no plain word.
    """
    from realsim.store import atomic

    if format == "realsim":
        atomic.write_json(path, to_json(intrinsics))
    elif format == "ros":
        if not name.replace("_", "").replace("-", "").isalnum():
            raise InputError(f"the camera's name '{name}' may have letters, digits, _ and - only.")
        atomic.write_text(path, ros_yaml(intrinsics, name))
    elif format == "opencv":
        atomic.write_text(path, opencv_yaml(intrinsics))
    else:
        raise InputError(f"the camera format '{format}' is not known; realsim, ros, opencv are.")


def number(value: float) -> str:
    """Return a number that reads back bit for bit, also where YAML 1.1 wants a point in it.

    Python's shortest text of 1e-17 has no point, and PyYAML reads such a number as a string.
    """
    text = repr(float(value))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def yaml_matrix(name: str, M: Array, *, opencv: bool = False) -> str:
    """Return a matrix as ROS's camera files have it, or as OpenCV's FileStorage does."""
    values = ", ".join(number(v) for v in M.ravel())
    tag, kind = (" !!opencv-matrix", "  dt: d\n") if opencv else ("", "")
    rows, columns = M.shape
    return f"{name}:{tag}\n  rows: {rows}\n  cols: {columns}\n{kind}  data: [{values}]\n"


def _coefficients(i: CameraIntrinsics) -> Array:
    """Return the five coefficients of the usual lens, or all eight of a rational one."""
    return i.distortion if np.any(i.distortion[5:] != 0) else i.distortion[:5]


def ros_yaml(i: CameraIntrinsics, name: str) -> str:
    """Return a camera as ROS's camera_info_manager reads it (raw image, rectification = 1)."""
    d = _coefficients(i)
    P = np.concatenate([i.K, np.zeros((3, 1))], axis=1)
    return (
        f'image_width: {i.width}\nimage_height: {i.height}\ncamera_name: "{name}"\n'
        + yaml_matrix("camera_matrix", i.K)
        + f"distortion_model: {'rational_polynomial' if len(d) > 5 else 'plumb_bob'}\n"
        + yaml_matrix("distortion_coefficients", d[None])
        + yaml_matrix("rectification_matrix", np.eye(3))
        + yaml_matrix("projection_matrix", P)
    )


def opencv_yaml(i: CameraIntrinsics) -> str:
    """Return a camera for cv2.FileStorage."""
    return (
        f"%YAML:1.0\n---\nimage_width: {i.width}\nimage_height: {i.height}\n"
        + yaml_matrix("camera_matrix", i.K, opencv=True)
        + yaml_matrix("distortion_coefficients", _coefficients(i)[None], opencv=True)
    )
