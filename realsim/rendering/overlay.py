"""Drawings on pictures: outlines, grasps, axes, points, depth maps and contact sheets."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from realsim.arrays import Array, Image, Int32, Int64, Mask
from realsim.errors import InputError
from realsim.geometry import camera, se3
from realsim.images import png_bytes
from realsim.records import CameraIntrinsics, GraspSet

Color = tuple[int, int, int]
INSTANCE_COLORS: tuple[Color, ...] = (
    (0, 158, 230), (230, 159, 0), (0, 180, 130), (240, 228, 66), (213, 94, 0), (204, 121, 167),
    (86, 110, 255), (255, 140, 180), (0, 210, 210), (170, 220, 70), (180, 120, 60), (160, 90, 220),
    (255, 90, 90), (110, 170, 140), (250, 200, 150), (130, 130, 250),
)  # fmt: skip
"""Okabe and Ito's colour-blind-safe colours first, then ones that stay apart in brightness."""
SCORE_STOPS = np.array([[213, 70, 20], [245, 205, 60], [0, 158, 130]], dtype=np.float64)
"""Colours of the labels 0, 0.5 and 1, p_hold or score: vermilion red, yellow, bluish green. Who
cannot tell red from green still tells these apart."""
PALE = 0.6
"""Share of white in the colour of a grasp whose p_hold is not sure."""
VERDICT_RGB: dict[str, Color] = {
    "accepted": (0, 170, 130),
    "doubtful": (250, 200, 50),
    "rejected": (222, 76, 10),
    "unchecked": (176, 180, 192),
}
"""Colours of the verdicts on poses: green, amber, red and grey that stay apart without red-green
vision."""
UNTRIED: Color = (150, 150, 150)
"""Colour of a grasp without a label."""
DASH_M = 0.007
"""Length of the dashes, and of the gaps, that a hand is drawn by whose p_hold is not sure [m]."""
FINGER_M = 0.05
"""Length of a drawn finger, from its tip back to the palm [m]."""
STEM_M = 0.04
"""Length of the drawn approach stem behind the palm [m]."""
PIECES = 8
"""Straight pieces per drawn segment, so that lines bend with the lens."""
SHIFT = 4
"""Fractional bits of OpenCV's drawing coordinates: sixteenths of a pixel."""
INK: Color = (24, 26, 30)
PAPER: Color = (247, 247, 245)


def instance_color(instance: int) -> Color:
    """Return the colour (r, g, b) of an instance: always the same for the same number."""
    return INSTANCE_COLORS[instance % len(INSTANCE_COLORS)]


def score_rgb(scores: ArrayLike) -> Image:
    """Return the colours (N, 3) of labels (N,) in [0, 1]: red, yellow, green; grey for NaN."""
    values = np.asarray(scores, dtype=np.float64).reshape(-1)
    at = np.clip(np.nan_to_num(values), 0.0, 1.0)
    stops = np.linspace(0.0, 1.0, len(SCORE_STOPS))
    rgb = np.stack([np.interp(at, stops, SCORE_STOPS[:, k]) for k in range(3)], -1)
    return np.where(np.isfinite(values)[:, None], rgb, UNTRIED).astype(np.uint8)


def score_color(score: float) -> Color:
    """Return the colour (r, g, b) of one label."""
    r, g, b = score_rgb(score)[0].tolist()
    return r, g, b


def score_hex(score: float) -> str:
    """Return the colour '#rrggbb' of one label."""
    return "#{:02x}{:02x}{:02x}".format(*score_color(score))


def grasp_rgb(grasps: GraspSet, rows: Int64) -> Image:
    """Return the colours (N, 3) of some grasps by their label, pale where p_hold is not sure."""
    rgb = score_rgb(grasps.labels[rows])
    pale = np.rint((1 - PALE) * rgb + PALE * 255.0).astype(np.uint8)
    return np.where(grasps.unsure[rows, None], pale, rgb)


def evenly_ranked(grasps: GraspSet, most: int, rows: Int64 | None = None) -> Int64:
    """Return `most` rows evenly through the ranking by label, best first, unknown ones last.

    So that what is drawn has the colours of the whole set.

    Args:
        grasps: the set.
        most: number of rows; all, if there are no more.
        rows: those to choose from; None = all.
    """
    rows = np.arange(len(grasps), dtype=np.int64) if rows is None else rows
    ranked = rows[np.argsort(-np.nan_to_num(grasps.labels[rows], nan=-1.0), kind="stable")]
    if len(ranked) <= most:
        return ranked
    return ranked[np.linspace(0, len(ranked) - 1, most).round().astype(np.int64)]


def dashed(lines: Sequence[Array], length_m: float = DASH_M) -> list[Array]:
    """Return polylines (K, 3) [m] as their dashes (2, 3); every straight piece ends with one."""
    dashes: list[Array] = []
    for line in lines:
        for a, b in pairwise(line):
            count = max(1, int(np.rint((np.linalg.norm(b - a) / length_m - 1) / 2)))
            at = np.arange(2 * count + 1)[:, None] / (2 * count + 1)
            points = a + at[:, :1] * (b - a)
            ends = np.concatenate([points, b[None]])
            dashes += [ends[k : k + 2] for k in range(0, len(ends) - 1, 2)]
    return dashes


def draw_outlines(
    rgb: Image, ids: Int32, colors: Mapping[int, Color] | None = None, thickness: int = 2
) -> Image:
    """Return the picture with every instance's mask outlined.

    Args:
        rgb: (H, W, 3).
        ids: (H, W) instance per pixel, negative = none.
        colors: colour per instance; default `instance_color`.
        thickness: width of the line, which lies inside the mask [px].
    """
    import cv2

    out = rgb.copy()
    kernel = np.ones((3, 3), np.uint8)
    for instance in np.unique(ids[ids >= 0]):
        mask = (ids == instance).astype(np.uint8)
        # Outside the picture counts as the object: an object cut by the border stays open there.
        core = cv2.erode(mask, kernel, iterations=thickness,
                         borderType=cv2.BORDER_CONSTANT, borderValue=1)  # fmt: skip
        dark = cv2.dilate(mask, kernel) - mask
        color = (colors or {}).get(int(instance), instance_color(int(instance)))
        out[(mask > 0) & (np.asarray(core) == 0)] = color
        # A dark hairline outside keeps the outline visible on any ground.
        hairline = (dark > 0) & (ids < 0)
        out[hairline] = (0.55 * out[hairline]).astype(np.uint8)
    return out


def draw_hatched(rgb: Image, mask: Mask, color: Color) -> Image:
    """Return the picture with a mask hatched by diagonal lines and outlined.

    Hatching tells the region apart from any colour that an object may have, and leaves visible what
    lies under it.

    Args:
        rgb: (H, W, 3).
        mask: (H, W) what is hatched.
        color: of the lines.
    """
    import cv2

    out = rgb.copy()
    if not mask.any():
        return out
    spacing, thickness = max(8, rgb.shape[0] // 72), 2
    rows, columns = np.nonzero(mask)
    line = (rows + columns) % spacing < thickness
    shade = 0.7 * out[rows, columns] + 0.3 * np.array(color)
    out[rows, columns] = np.where(line[:, None], np.array(color), shade).astype(np.uint8)
    full = mask.astype(np.uint8)
    core = cv2.erode(full, np.ones((3, 3), np.uint8), iterations=thickness,
                     borderType=cv2.BORDER_CONSTANT, borderValue=1)  # fmt: skip
    out[mask & (np.asarray(core) == 0)] = color
    return out


def _polyline(
    canvas: Any, intrinsics: CameraIntrinsics, points_cam: Array, color: Color, width_px: int
) -> None:
    """Draw a line through camera points (N, 3), bent as the lens bends it, with a dark rim."""
    import cv2

    step = np.linspace(0, 1, PIECES, endpoint=False)[:, None]
    parts = [a + step * (b - a) for a, b in pairwise(points_cam)]
    line = np.concatenate([*parts, points_cam[-1:]])
    uv = camera.project(intrinsics, line)
    reach = 8 * max(intrinsics.width, intrinsics.height)
    # A point behind the camera is NaN, and NaN is less than nothing.
    seen: Mask = np.all(np.abs(uv) < reach, axis=-1)
    for run in np.split(np.arange(len(uv)), np.flatnonzero(~seen)):
        kept = run[seen[run]]
        if len(kept) < 2:
            continue
        fixed = [np.round(uv[kept] * (1 << SHIFT)).astype(np.int32)]
        cv2.polylines(canvas, fixed, False, INK, width_px + 2, cv2.LINE_AA, SHIFT)
        cv2.polylines(canvas, fixed, False, color, width_px, cv2.LINE_AA, SHIFT)


def gripper_lines(width_m: float) -> list[Array]:
    """Return the lines (K, 3) of a gripper in its grasp frame [m]: a U and its stem.

    The origin lies between the fingertips, z is the approach, y the closing axis: the fingers
    stand at y = +- width / 2 and reach back along -z to the palm.
    """
    y = width_m / 2
    u = [[0, -y, 0], [0, -y, -FINGER_M], [0, y, -FINGER_M], [0, y, 0]]
    stem = [[0, 0, -FINGER_M], [0, 0, -FINGER_M - STEM_M]]
    return [np.array(u, dtype=np.float64), np.array(stem, dtype=np.float64)]


def draw_grasps(
    rgb: Image,
    intrinsics: CameraIntrinsics,
    T_cam_obj: ArrayLike,
    grasps: GraspSet,
    indices: Sequence[int] | Int64 | None = None,
    color_by: Literal["label", "instance"] = "label",
) -> Image:
    """Return the picture with grippers drawn far to near, nearer ones with wider lines.

    Grippers of grasps whose p_hold is not sure are dashed.

    Args:
        rgb: (H, W, 3).
        intrinsics: the raw camera of the picture.
        T_cam_obj: (4, 4) the grasps' object in camera [m].
        grasps: the grasps.
        indices: which of them; default all.
        color_by: by p_hold, of sets without it by score, red, yellow, green (grey = not known), or
            by instance.
    """
    out = rgb.copy()
    chosen = np.arange(len(grasps)) if indices is None else np.asarray(indices, dtype=np.int64)
    Ts_cam_grasp = np.asarray(T_cam_obj, dtype=np.float64) @ grasps.Ts_obj_pads[chosen]
    depth = Ts_cam_grasp[:, 2, 3]
    labels, unsure = grasps.labels, grasps.unsure
    for k in np.argsort(-depth):
        g = int(chosen[k])
        if depth[k] <= 0:
            continue
        color = (
            score_color(float(labels[g]))
            if color_by == "label"
            else instance_color(grasps.instance)
        )
        # About 2.5 mm thick at its depth, within what reads well: 6 px in a picture 1280 px wide.
        thickest = int(np.clip(intrinsics.width // 213, 3, 6))
        width_px = int(np.clip(np.round(0.0025 * intrinsics.fx / depth[k]), 1, thickest))
        lines = gripper_lines(float(grasps.widths_m[g]))
        for line in dashed(lines) if unsure[g] else lines:
            points = se3.transform(Ts_cam_grasp[k], line)
            _polyline(out, intrinsics, points, color, width_px)
    return out


def draw_axes(
    rgb: Image,
    intrinsics: CameraIntrinsics,
    T_cam_x: ArrayLike,
    length_m: float = 0.05,
    thickness: int = 3,
) -> Image:
    """Return the picture with a frame's axes: x red, y green, z blue, far to near."""
    out = rgb.copy()
    T = np.asarray(T_cam_x, dtype=np.float64)
    axes: list[tuple[int, Color]] = [(0, (226, 60, 60)), (1, (60, 180, 75)), (2, (66, 118, 240))]
    for axis, color in sorted(axes, key=lambda a: -float(T[2, a[0]])):
        tip = T[:3, 3] + length_m * T[:3, axis]
        _polyline(out, intrinsics, np.stack([T[:3, 3], tip]), color, thickness)
    return out


def depth_picture(
    depth_m: ArrayLike, low_m: float | None = None, high_m: float | None = None
) -> Image:
    """Return depth (H, W) [m] as a picture: near is red, far is blue, no measurement is black.

    Args:
        depth_m: (H, W), 0 = none.
        low_m: depth of the near end [m]; default the 1st percentile.
        high_m: depth of the far end [m]; default the 99th percentile.
    """
    import cv2

    depth = np.asarray(depth_m, dtype=np.float32)
    valid = np.isfinite(depth) & (depth > 0)
    if not bool(valid.any()):
        return np.zeros((*depth.shape, 3), np.uint8)
    low = float(np.percentile(depth[valid], 1)) if low_m is None else low_m
    high = float(np.percentile(depth[valid], 99)) if high_m is None else high_m
    nearness = 1 - np.clip((np.where(valid, depth, low) - low) / max(high - low, 1e-6), 0, 1)
    # The ends of turbo are nearly black: keep off them, because black means none.
    index = np.round(255 * (0.08 + 0.86 * nearness)).astype(np.uint8)
    bgr = np.asarray(cv2.applyColorMap(index, cv2.COLORMAP_TURBO), np.uint8)
    return np.where(valid[..., None], bgr[..., ::-1], 0).astype(np.uint8)


def contact_sheet(
    images: Sequence[Image], columns: int, captions: Sequence[str] | None = None
) -> Image:
    """Return pictures in a grid, each above its caption.

    Args:
        images: (H, W, 3) or (H, W) each; all are fitted into the first one's size.
        columns: pictures per row.
        captions: one per picture, or None.

    Raises:
        InputError: no pictures, no columns, or another number of captions.
    """
    import cv2

    if not images or columns < 1:
        raise InputError("a contact sheet needs at least one picture and one column.")
    if captions is not None and len(captions) != len(images):
        raise InputError(f"{len(captions)} captions for {len(images)} pictures.")
    height, width = images[0].shape[:2]
    gap = max(6, width // 80)
    size = float(np.clip(width / 900, 0.38, 1.2))
    strip = round(34 * size) if captions is not None else 0
    columns = min(columns, len(images))
    rows = -(-len(images) // columns)
    sheet = np.empty((rows * (height + strip + gap) + gap, columns * (width + gap) + gap, 3),
                     np.uint8)  # fmt: skip
    sheet[:] = PAPER
    for k, image in enumerate(images):
        r, c = divmod(k, columns)
        y, x = gap + r * (height + strip + gap), gap + c * (width + gap)
        picture = np.repeat(image[..., None], 3, -1) if image.ndim == 2 else image
        factor = min(height / picture.shape[0], width / picture.shape[1])
        w, h = round(picture.shape[1] * factor), round(picture.shape[0] * factor)
        if (h, w) != picture.shape[:2]:
            picture = cv2.resize(picture, (w, h), interpolation=cv2.INTER_AREA)
        top, left = y + (height - h) // 2, x + (width - w) // 2
        sheet[top : top + h, left : left + w] = picture
        if captions is not None:
            at = (x + 2, y + height + round(24 * size))
            text = _fitted(captions[k], width - 4, size)
            cv2.putText(sheet, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, INK, 1, cv2.LINE_AA)
    return sheet


def _fitted(text: str, width_px: int, size: float) -> str:
    """Return the text, shortened by an ellipsis if it is wider than `width_px`."""
    import cv2

    def wide(t: str) -> bool:
        return cv2.getTextSize(t, cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0][0] > width_px

    if not wide(text):
        return text
    while text and wide(text + "..."):
        text = text[:-1]
    return text + "..."


def save_png(path: Path | str, rgb: Image) -> None:
    """Write a picture (H, W, 3) as PNG, by way of a temporary name.

    Raises:
        InputError: the folder does not exist or cannot be written, or that is no picture.
    """
    path, data = Path(path), png_bytes(np.ascontiguousarray(rgb))
    partial = path.with_name(path.name + ".part")
    try:
        partial.write_bytes(data)
        partial.replace(path)
    except OSError as error:
        raise InputError(
            f"{path} cannot be written: {error.strerror}. Does the folder exist?"
        ) from error
