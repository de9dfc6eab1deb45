"""Words on pictures: names under objects and a small legend, kept clear of what is shown."""

from collections.abc import Mapping, Sequence

import numpy as np

from realsim.arrays import Image, Int32, Mask
from realsim.rendering.overlay import INK, PAPER, Color, score_rgb


def text_scale(shape: Sequence[int]) -> float:
    """Return OpenCV's font scale for a picture (H, W, ...): legible, not larger than an object."""
    return float(np.clip(shape[0] / 1400, 0.35, 0.9))


def write_names(
    rgb: Image, ids: Int32, names: Mapping[int, str], colors: Mapping[int, Color]
) -> Image:
    """Return the picture with every object's name under it; names that would overlap move away.

    Args:
        rgb: (H, W, 3).
        ids: (H, W) instance per pixel, negative = none; objects without a pixel are left out.
        names: name per instance.
        colors: colour of the letters per instance.
    """
    import cv2

    out = np.ascontiguousarray(rgb.copy())
    size = text_scale(rgb.shape)
    taken: list[tuple[int, int, int]] = []
    for instance, name in names.items():
        rows, columns = np.nonzero(ids == instance)
        if len(rows) == 0:
            continue
        (w, h), _ = cv2.getTextSize(name, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
        pad = max(2, h // 3)
        step, most = h + 3 * pad, out.shape[0] - pad
        x = int(np.clip(float(columns.mean()) - w / 2, pad, max(pad, out.shape[1] - w - pad)))
        y = min(int(rows.max()) + h + 3 * pad, most)
        down = 1 if y + len(names) * step <= most else -1
        while any(abs(y - v) < step and x < u + b + pad and u < x + w + pad for u, v, b in taken):
            y += down * step
        y = int(np.clip(y, h + pad, most))
        taken.append((x, y, w))
        cv2.rectangle(out, (x - pad, y - h - pad), (x + w + pad, y + pad), INK, -1)
        cv2.putText(
            out, name, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, colors[instance], 1, cv2.LINE_AA
        )
    return out


def write_legend(
    rgb: Image,
    entries: Sequence[tuple[str, Color]],
    busy: Mask,
    *,
    ramp: str = "",
    lines: Sequence[str] = (),
) -> Image:
    """Return the picture with a small legend in the corner that hides least.

    Args:
        rgb: (H, W, 3).
        entries: (text, colour) each.
        busy: (H, W) what should not be covered.
        ramp: what the colours of the grasps say, 'p_hold' or 'score'; '' = no grasps are drawn.
        lines: further text without a colour.
    """
    import cv2

    if not (entries or ramp or lines):
        return rgb.copy()
    size = 0.85 * text_scale(rgb.shape)
    row, pad = round(34 * size), round(12 * size)
    told = [f"{ramp} of the grasp, 0 to 1"] if ramp else []
    texts = [t for t, _ in entries] + told + list(lines)
    wide = [cv2.getTextSize(t, cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0][0] for t in texts]
    swatch = round(1.6 * row)
    w = min(max(wide) + swatch + 3 * pad, rgb.shape[1])
    h = min(row * len(texts) + 2 * pad, rgb.shape[0])
    top, left = _free_corner(busy, h, w)
    out = np.ascontiguousarray(rgb.copy())
    ground = out[top : top + h, left : left + w]
    ground[:] = np.round(0.2 * ground + 0.8 * np.array(PAPER)).astype(np.uint8)
    for k, text in enumerate(texts):
        y, x = pad + k * row, pad
        bar = ground[y + row // 5 : y + row * 4 // 5, x : x + swatch]
        if k < len(entries):
            bar[:] = entries[k][1]
        elif ramp and k == len(entries):
            bar[:] = score_rgb(np.linspace(0, 1, bar.shape[1]))
        start = x + swatch + pad if k < len(entries) + len(told) else x
        cv2.putText(
            ground, text, (start, y + row * 3 // 4), cv2.FONT_HERSHEY_SIMPLEX, size, INK, 1,
            cv2.LINE_AA,
        )  # fmt: skip
    return out


def _free_corner(busy: Mask, h: int, w: int) -> tuple[int, int]:
    """Return top and left of a box (h, w) in the corner with the fewest busy pixels."""
    height, width = busy.shape
    corners = [(height - h, 0), (height - h, width - w), (0, 0), (0, width - w)]
    covered = [np.count_nonzero(busy[t : t + h, x : x + w]) for t, x in corners]
    return corners[int(np.argmin(covered))]
