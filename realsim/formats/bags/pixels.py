"""From an image message to pixels: colour as RGB, depth as metres or as counts of 16 bit.

Also what one count of a depth image means, and whether that can be.
"""

import contextlib
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array32, UInt8, UInt16
from realsim.errors import InputError, UnitError
from realsim.formats.bags.wire import ImageMessage
from realsim.images import require_decodable

Kind = Literal["colour", "grey", "depth", "other"]

CHANNELS = {
    "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1,
    "yuv422": 2, "yuv422_yuy2": 2, "uyvy": 2, "yuyv": 2,
    "bayer_rggb8": 1, "bayer_bggr8": 1, "bayer_gbrg8": 1, "bayer_grbg8": 1,
}  # fmt: skip
"""Bytes per pixel of the 8-bit encodings that are read."""
CONVERSION = {
    "bgr8": "COLOR_BGR2RGB", "rgba8": "COLOR_RGBA2RGB", "bgra8": "COLOR_BGRA2RGB",
    "mono8": "COLOR_GRAY2RGB", "8UC1": "COLOR_GRAY2RGB",
    # ROS's plain yuv422 is UYVY; YUY2 has a name of its own.
    "yuv422": "COLOR_YUV2RGB_UYVY", "uyvy": "COLOR_YUV2RGB_UYVY",
    "yuv422_yuy2": "COLOR_YUV2RGB_YUY2", "yuyv": "COLOR_YUV2RGB_YUY2",
    "bayer_rggb8": "COLOR_BayerRGGB2RGB", "bayer_bggr8": "COLOR_BayerBGGR2RGB",
    "bayer_gbrg8": "COLOR_BayerGBRG2RGB", "bayer_grbg8": "COLOR_BayerGRBG2RGB",
}  # fmt: skip
"""OpenCV's name of the way to RGB."""
GREY = ("mono8", "8UC1")
DEPTH_COUNTS = ("16UC1", "mono16", "16UC1 png")
DEPTH_METRES = ("32FC1",)
DEPTH_HEADER_BYTES = 12
"""compressedDepth puts an enum and two float32 quantisation parameters before the PNG."""


class ImageKind(NamedTuple):
    """What an image message holds."""

    kind: Kind
    width: int
    height: int
    encoding: str
    """Encoding of the pixels once decoded: of a compressed depth image 16UC1 or 32FC1."""


def kind_of(message: ImageMessage, compressed: bool) -> ImageKind:
    """Return what the images of a topic are, from one of its messages.

    A compressed image is decoded for it: what its format string says is not reliable.
    """
    if not compressed:
        e = message.encoding
        if e in DEPTH_COUNTS or e in DEPTH_METRES:
            kind: Kind = "depth"
        elif e in CHANNELS:
            kind = "grey" if e in GREY else "colour"
        else:
            kind = "other"
        return ImageKind(kind, message.width, message.height, e)
    try:
        image = _decompressed(message)
    except InputError:
        return ImageKind("other", 0, 0, message.encoding)
    height, width = image.shape[:2]
    if image.dtype == np.uint8:
        kind = "grey" if image.ndim == 2 else "colour"
        return ImageKind(kind, width, height, message.encoding)
    if image.ndim != 2:
        return ImageKind("other", width, height, message.encoding)
    is_float = message.encoding.strip().startswith("32FC1")
    return ImageKind("depth", width, height, "32FC1" if is_float else "16UC1")


def rgb_of(message: ImageMessage, compressed: bool, name: str) -> UInt8:
    """Return (H, W, 3) uint8 RGB; a view of the message where it is rgb8 already.

    Raises:
        InputError: the encoding is not a colour one, or the message is damaged; names it.
    """
    import cv2

    if compressed:
        image = _decompressed(message, name)
        if image.dtype != np.uint8:
            raise InputError(f"{name}: a colour image is expected; {image.dtype} was found.")
        code = cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB
        return np.asarray(cv2.cvtColor(image[..., :3] if image.ndim == 3 else image, code), "u1")
    channels = CHANNELS.get(message.encoding)
    if channels is None:
        raise InputError(
            f"{name}: the encoding '{message.encoding}' is not a colour one; "
            f"{', '.join(CHANNELS)} and JPEG or PNG are read."
        )
    rows = _rows(message, message.width * channels, name)
    if channels > 1:
        rows = rows.reshape(message.height, message.width, channels)
    if message.encoding == "rgb8":
        return rows
    image = np.ascontiguousarray(rows)
    return np.asarray(cv2.cvtColor(image, getattr(cv2, CONVERSION[message.encoding])), "u1")


def depth_of(message: ImageMessage, compressed: bool, name: str) -> NDArray[Any]:
    """Return depth (H, W): uint16 counts, or float32 metres with NaN or 0 = none.

    Raises:
        InputError: the encoding is not a depth one, or the message is damaged; names it.
    """
    if compressed:
        image = _decompressed(message, name)
        if image.ndim != 2 or image.dtype != np.uint16:
            raise InputError(
                f"{name}: a depth image has one channel of 16 bit; {image.dtype} {image.shape} "
                "was found. Was the topic recorded as JPEG, which cannot hold depth?"
            )
        if not message.encoding.strip().startswith("32FC1"):
            return image
        return _inverse_depth(message, image)
    order = ">" if message.big_endian else "<"
    if message.encoding in DEPTH_COUNTS:
        rows = _rows(message, message.width * 2, name)
        counts = np.ascontiguousarray(rows).view(f"{order}u2")
        return counts.astype(np.uint16, copy=False)
    if message.encoding in DEPTH_METRES:
        rows = _rows(message, message.width * 4, name)
        return np.ascontiguousarray(rows).view(f"{order}f4").astype(np.float32, copy=False)
    raise InputError(
        f"{name}: the encoding '{message.encoding}' is not a depth one; 16UC1, mono16 and 32FC1 "
        "are read."
    )


def _rows(message: ImageMessage, used: int, name: str) -> UInt8:
    """Return the rows (H, used) of a raw image without their padding, as a view.

    Raises:
        InputError: the message has fewer bytes than its size says.
    """
    step = message.step or used
    if step < used or len(message.pixels) < step * (message.height - 1) + used:
        raise InputError(
            f"{name}: {message.width}x{message.height} {message.encoding} with rows of {step} "
            f"bytes cannot be in {len(message.pixels)} bytes. The message is damaged."
        )
    pixels = message.pixels
    if message.height == 1:  # its padding can be claimed to be gigabytes, and nothing follows it
        return pixels[:used].reshape(1, used)
    if len(pixels) < step * message.height:  # some drivers leave out the last row's padding
        pixels = np.concatenate([pixels, np.zeros(step * message.height - len(pixels), np.uint8)])
    return pixels[: step * message.height].reshape(message.height, step)[:, :used]


def _decompressed(message: ImageMessage, name: str = "image") -> NDArray[Any]:
    """Return a compressed image as OpenCV decodes it: (H, W) or (H, W, 3 or 4) BGR.

    Raises:
        InputError: it is damaged or neither JPEG nor PNG.
    """
    import cv2

    skip = DEPTH_HEADER_BYTES if "compressedDepth" in message.encoding else 0
    data = message.pixels[skip:]
    image: Any = None
    # cv2.error: of images that end within a header.
    with contextlib.suppress(InputError, cv2.error):
        require_decodable(data.tobytes(), name)
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(
            f"{name}: a compressed image of format '{message.encoding}' and {len(data)} bytes "
            "cannot be decoded; JPEG and PNG are read (not RVL, H.264 or theora). Republish the "
            "topic raw, or choose another one."
        )
    return np.asarray(image)


def _inverse_depth(message: ImageMessage, quantised: NDArray[Any]) -> Array32:
    """Return metres of compressedDepth's 32FC1: depth = A / (value - B), 0 = none.

    The two parameters are in the 12 bytes before the PNG (compressed_depth_image_transport).
    """
    a, b = np.frombuffer(message.pixels[4:DEPTH_HEADER_BYTES].tobytes(), "<f4").astype(np.float64)
    value = quantised.astype(np.float64) - b
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where((quantised > 0) & (value > 0), a / value, 0.0)
    return depth.astype(np.float32)


MILLIMETRE = 1e-3
FINE_UNIT_M = 1e-4
"""Float metres are stored in tenths of a millimetre as far as 16 bit reach (6.5 m)."""
COUNT_MAX = 65535
HEADROOM = 1.3
"""Frames that were not looked at may be this much deeper."""
NEAREST_M, FARTHEST_M = 0.05, 20.0
"""A depth camera's median depth lies between these, or the unit is wrong."""


def unit_of(
    images: Sequence[NDArray[Any]],
    topic: str,
    encoding: str,
    given: float | None,
    recorded: float | None,
) -> tuple[float, str]:
    """Return metres per count to store depth in, and a note on where it comes from.

    Args:
        images: some depth images of the recording, uint16 counts or float32 metres.
        topic: what messages call it.
        encoding: of the messages.
        given: unit that a person gave [m].
        recorded: unit that the recording says [m].

    Raises:
        UnitError: 16-bit depth of an unknown unit, or one with which the depth cannot be right.
    """
    values = np.concatenate([i[np.isfinite(i) & (i > 0)].ravel() for i in images] or [np.zeros(0)])
    median = float(np.median(values)) if len(values) else 0.0
    if images and images[0].dtype != np.uint16:
        _check_median(median, topic, "metres (32FC1)")
        if given is not None:
            return given, f"{topic}: float metres were stored in counts of {given:g} m."
        deepest = float(values.max()) if len(values) else 0.0
        unit = FINE_UNIT_M if deepest * HEADROOM < FINE_UNIT_M * COUNT_MAX else MILLIMETRE
        reach = unit * COUNT_MAX
        return unit, (
            f"{topic}: float metres were stored in counts of {unit:g} m; beyond {reach:.1f} m "
            "counts as no measurement."
        )
    unit = given or recorded
    if unit is not None:
        source = "given" if given else "recorded with the depth"
        if given and recorded and abs(given / recorded - 1) > 1e-3:
            source = f"given, against {recorded:g} m in the recording"
        _check_median(median * unit, topic, f"counts of {unit:g} m ({source})")
        return unit, f"{topic}: one count is {unit:g} m ({source}); median {median * unit:.3f} m."
    if encoding != "16UC1":
        raise UnitError(
            f"{topic}: depth of 16 bit as '{encoding}' has no unit (only for 16UC1 ROS says "
            f"millimetres). Its median is {median:.0f} counts: {median * 1e-3:.3f} m in "
            f"millimetres, {median * 1e-4:.3f} m in tenths. Give depth_unit_m=0.001 or 0.0001."
        )
    _check_median(median * MILLIMETRE, topic, "millimetres (ROS's rule for 16UC1)")
    return MILLIMETRE, (
        f"{topic}: 16UC1 was taken as millimetres (ROS REP 118), which makes the median depth "
        f"{median * MILLIMETRE:.3f} m; give depth_unit_m= if that is wrong."
    )


def _check_median(median_m: float, topic: str, assumed: str) -> None:
    """Refuse a unit that puts the scene where no depth camera sees; no depth at all passes."""
    if median_m and not NEAREST_M <= median_m <= FARTHEST_M:
        raise UnitError(
            f"{topic}: read as {assumed}, the median depth is {median_m:.4g} m; between "
            f"{NEAREST_M} and {FARTHEST_M} m is plausible. Give the unit: depth_unit_m=0.001 "
            "(millimetres), 0.0001 (a D405's own), or what the camera was set to."
        )


def counts_of(depth: NDArray[Any], unit_m: float) -> UInt16:
    """Return depth as counts of a unit; float metres that do not fit become 0 = none."""
    if depth.dtype == np.uint16:
        return depth
    counts = np.rint(depth / np.float32(unit_m))
    with np.errstate(invalid="ignore"):
        fits = (counts > 0) & (counts <= COUNT_MAX)
    return np.where(fits, counts, 0).astype(np.uint16)
