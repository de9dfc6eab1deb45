"""The user's own panorama as an environment: read, checked, its sun taken out of it.

Photographed panoramas show what a viewer sees who turns to the right as the column grows, that is
clockwise from above; `Environment` counts azimuths the other way, so the columns are turned round.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.arrays import Array32
from realsim.errors import InputError
from realsim.geometry.colors import light_of_bytes, luminance
from realsim.rendering.appearance import Color, Environment
from realsim.rendering.procedural.skies import directions, exposed, solid_angles

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


def _read_exr(path: Path) -> Array32:
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


LARGEST_ROWS = 1024
"""Panoramas are reduced to this height: 0.18 deg a texel."""
ASPECT_SLACK = 0.01
"""A panorama cropped by a few columns still is one."""
SUN_REACH_DEG = 4.0
"""A light within so many degrees of the brightest texel can be the sun; larger is a lamp."""
RIM_DEG = 7.0
"""What lies between the reach and this is the sky around the sun."""
SUN_OVER_RIM = 20.0
"""The brightest texel of a sun is so many times brighter than the sky around it."""
SUN_SHARE = 0.1
"""A sun brings at least this share of all light, or it is not worth its own shadow."""
LEAST_SUN_RADIUS_DEG = 0.27
"""The true sun's radius, however coarse the panorama [deg]."""


def read_environment(
    path: Path | str, exposure: float | None = None, notes: list[str] | None = None
) -> Environment:
    """Read an equirectangular panorama: Radiance .hdr, OpenEXR .exr, or a picture.

    Args:
        path: the file.
        exposure: factor from its radiances to the value in which 1 is white; None = a grey card
            that lies flat comes out mid-grey.
        notes: what was mended or guessed is added to it, for people.

    Raises:
        InputError: no such file, a broken one, not twice as wide as high, black, or an exposure
            that is not positive.
    """
    path = Path(path)
    notes = [] if notes is None else notes
    if exposure is not None and not (np.isfinite(exposure) and exposure > 0):
        raise InputError(f"an exposure of {exposure} is no factor; a positive number is accepted.")
    image = read_picture(path)
    height, width = image.shape[:2]
    if abs(width / height - 2.0) > 2 * ASPECT_SLACK or height < 4:
        raise InputError(
            f"{path} is {width}x{height}; an equirectangular panorama, twice as wide as high (such "
            "as 2048x1024), is accepted. Cube maps and mirror balls must be converted first."
        )
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, -1)
    if path.suffix.lower() in HDR or image.dtype.kind == "f":
        radiance = _mended(np.asarray(image, np.float32), path, notes)
    else:
        radiance = _decoded(image, path, notes)
    radiance = _fitted(radiance, path, notes)[:, ::-1]
    if not float(radiance.max()) > 0:
        raise InputError(f"{path} is black all over; a panorama with light in it is needed.")
    panorama, sun, toward, radius = split_sun(radiance)
    if max(sun) > 0:
        notes.append(
            f"{path.name}: a sun {np.degrees(np.arcsin(np.clip(toward[2], -1, 1))):.0f} deg over "
            "the horizon was taken out of the panorama, so that its shadows are sharp."
        )
    made = Environment(panorama=panorama.astype(np.float32), sun=sun, sun_direction=toward,
                       sun_radius_deg=radius, exposure=exposure or 1.0, name=path.stem)  # fmt: skip
    return made if exposure is not None else exposed(made)


def _mended(radiance: Array32, path: Path, notes: list[str]) -> Array32:
    """Return radiances that are finite and not negative; what was mended is noted."""
    bad = ~np.isfinite(radiance)
    infinite = np.isposinf(radiance)
    negative = ~bad & (radiance < 0)
    if not bad.any() and not negative.any():
        return radiance
    counts = {
        "not a number": int((bad & ~infinite).sum()),
        "infinite": int(infinite.sum()),
        "negative": int(negative.sum()),
    }
    if bad.all():
        raise InputError(f"{path} holds no finite value; export the panorama again.")
    top = np.float32(radiance[~bad].max())
    out = np.where(infinite, max(top, np.float32(0)), np.where(bad | negative, 0, radiance))
    what = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    notes.append(
        f"{path.name}: of {radiance.size} values {what}; infinite ones were set to the largest "
        f"other ({top:g}), the rest to 0. The light may be off where they were."
    )
    return out.astype(np.float32)


def _decoded(image: NDArray[Any], path: Path, notes: list[str]) -> Array32:
    """Return the linear light of an sRGB picture of 8 or 16 bits."""
    top = float(np.iinfo(image.dtype).max)
    linear = light_of_bytes(image.astype(np.float64) * (255.0 / top))
    clipped = float(np.mean(np.max(image, -1).astype(np.float64) >= top))
    notes.append(
        f"{path.name} is a picture without high dynamic range: lamps and sun are no brighter than "
        f"white ({100 * clipped:.1f} % of it is), so that shadows will be weak. A .hdr or .exr "
        "panorama lights better."
    )
    return linear.astype(np.float32)


def _fitted(radiance: Array32, path: Path, notes: list[str]) -> Array32:
    """Return the panorama at exactly 2:1 and at most 1024 rows, its light averaged by area."""
    import cv2

    height, width = radiance.shape[:2]
    rows = min(height, LARGEST_ROWS)
    if (rows, 2 * rows) == (height, width):
        return radiance
    notes.append(f"{path.name}: reduced from {width}x{height} to {2 * rows}x{rows}.")
    out = cv2.resize(radiance, (2 * rows, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(out, np.float32)


def split_sun(panorama: Array32) -> tuple[Array32, Color, Color, float]:
    """Take a small, very bright light above the horizon out of a panorama.

    The excess over the sky around it moves from the panorama into the sun, and the sun stands in
    the direction of the excess' irradiance vector; so every surface that sees the whole of it
    receives what it received before.

    Args:
        panorama: (H, 2H, 3) linear radiance.

    Returns:
        The panorama without it (H, 2H, 3), the sun's irradiance divided by pi, its direction and
        its radius [deg]. Where there is no such light: the panorama as it was, and (0, 0, 0).
    """
    height = panorama.shape[0]
    view, size = directions(height), solid_angles(height)
    bright = luminance(panorama)
    row, column = np.unravel_index(int(np.argmax(bright)), bright.shape)
    peak = float(bright[row, column])
    none = panorama, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), LEAST_SUN_RADIUS_DEG
    if row >= height // 2 or peak <= 0:
        return none
    center = view[row, column]
    texel_deg = 180.0 / height
    reach = max(SUN_REACH_DEG, 1.5 * texel_deg)
    cosine = view @ center
    cap = cosine >= np.cos(np.radians(reach))
    rim = ~cap & (cosine >= np.cos(np.radians(max(RIM_DEG, reach + 2 * texel_deg))))
    sky = np.median(panorama[rim], axis=0).astype(np.float64)
    if peak < SUN_OVER_RIM * max(float(luminance(sky)), 1e-12):
        return none
    omega = np.broadcast_to(size[:, None], bright.shape)
    excess = np.maximum(panorama[cap].astype(np.float64) - sky, 0.0)
    each = excess * omega[cap][:, None]
    total = float((bright * omega).sum())
    if float(luminance(each).sum()) < SUN_SHARE * total:
        return none
    vector = luminance(each) @ view[cap]
    toward = vector / np.linalg.norm(vector)
    irradiance = (view[cap] @ toward) @ each
    out = panorama.copy()
    out[cap] = (panorama[cap] - excess).astype(np.float32)
    # The disc of even brightness that would have the same light at the same peak.
    disc = float(luminance(each).sum()) / peak
    radius = float(np.degrees(np.sqrt(disc / np.pi)))
    r, g, b = (irradiance / np.pi).tolist()
    x, y, z = toward.tolist()
    return out, (r, g, b), (x, y, z), float(np.clip(radius, LEAST_SUN_RADIUS_DEG, reach))
