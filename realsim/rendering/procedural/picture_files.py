"""Reading pictures of any bit depth, among them OpenEXR where something can read it."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.errors import InputError

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
HDR = (".hdr", ".exr")


def read_picture(path: Path) -> NDArray[Any]:
    """Return a picture as it is stored: (H, W) or (H, W, 3) RGB, uint8, uint16 or float32.

    Alpha is left away.

    Raises:
        InputError: no such file, another format, a broken file, or no reader for OpenEXR.
    """
    import cv2

    kind = path.suffix.lower()
    if kind not in (*PICTURES, *HDR):
        raise InputError(
            f"{path}: '{kind}' is no picture that can be read; {', '.join((*PICTURES, *HDR))} are."
        )
    if not path.is_file():
        raise InputError(f"{path} does not exist; a picture was expected there.")
    if kind == ".exr":
        return _read_exr(path)
    data = np.frombuffer(path.read_bytes(), np.uint8)
    try:
        image: Any = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    except cv2.error:
        image = None
    if image is None:
        raise InputError(
            f"{path} ({len(data)} bytes) cannot be decoded as a {kind[1:]} picture; it is broken "
            "or cut off. Save it again."
        )
    return _rgb(np.asarray(image)[..., ::-1] if image.ndim == 3 and image.shape[2] == 3 else
                np.asarray(image), bgra=True)  # fmt: skip


def _rgb(image: NDArray[Any], bgra: bool) -> NDArray[Any]:
    """Return a picture without alpha."""
    if image.ndim == 3 and image.shape[2] == 4:
        image = image[..., 2::-1] if bgra else image[..., :3]
    if image.ndim == 3 and image.shape[2] in (1, 2):
        image = image[..., 0]
    return np.ascontiguousarray(image)


def _read_exr(path: Path) -> NDArray[np.float32]:
    """Return an OpenEXR picture, by Mitsuba's reader.

    Raises:
        InputError: Mitsuba is not installed, or the file is broken.
    """
    if path.read_bytes()[:4] != b"\x76\x2f\x31\x01":
        raise InputError(f"{path} is not an OpenEXR file, whatever its name says. Export it again.")
    try:
        import mitsuba
    except ImportError as error:
        raise InputError(
            f"{path}: OpenEXR is read by Mitsuba, which is not installed (OpenCV's wheel has no "
            "reader). Install the extra realsim[photo], or convert the file to Radiance .hdr."
        ) from error
    try:
        if mitsuba.variant() is None:
            mitsuba.set_variant("scalar_rgb")
        bitmap = mitsuba.Bitmap(str(path)).convert(
            component_format=mitsuba.Struct.Type.Float32, srgb_gamma=False
        )
        return _rgb(np.array(bitmap, np.float32), bgra=False)
    except Exception as error:  # the reader raises its own kinds
        raise InputError(
            f"{path} cannot be read as OpenEXR ({error}). Convert it to Radiance .hdr."
        ) from error
