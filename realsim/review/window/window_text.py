"""What the review page says of an object, as the markdown of its panels.

Names and comments come from other people and from files: they are escaped, so that a comment can
neither look like a button nor bring a script along.
"""

import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.geometry.colors import light_of_bytes, luminance
from realsim.records import ObjectModel, ObjectPose
from realsim.rendering.overlay import VERDICT_RGB
from realsim.review.journal import Entry
from realsim.review.placing.ellipsoid import pose_sigmas
from realsim.review.replaying.grasp_words import escaped, one_line
from realsim.review.scene_list import ObjectRow

GREY = (134, 142, 150)
"""The colour of buttons that take back."""
ALARM = "#c92a2a"
"""The red of what is amiss."""
LEAST_CONTRAST = 4.5
"""Least contrast of letters to their ground: what WCAG 2.1 asks for at the size of the panel's
text."""
BUG = "This is a bug in realsim, please report it with the log: {!r}"
"""Where the error stands."""
NO_PHOTOGRAPHS = (
    "No view of this scene has a photograph, its depth and a camera pose: objects, table and "
    "grasps are shown alone. Copy the images back, or run `realsim calibrate`, then start "
    "`realsim review` again."
)
ACTION_WORDS = {
    "accept": "accepted",
    "reject": "rejected",
    "comment": "commented",
    "move": "moved it",
    "swap": "swapped its id",
    "symmetric": "marked it symmetric",
    "exclude": "left the view out",
    "include": "took the view in",
}


@dataclass(frozen=True, slots=True)
class CheckWords:
    """How a check is shown."""

    words: str
    unit: str = ""
    scale: float = 1.0


MAIN_CHECKS = {
    "agree": CheckWords("pixels that agree with the measured depth", "%", 100),
    "cover": CheckWords("its seen surface that was measured", "%", 100),
    "free_space_violation": CheckWords("pixels where the camera looked through it", "%", 100),
    "residual_median_mm": CheckWords("median distance to the measured points", "mm"),
    "held_out_shift_mm": CheckWords("shift when views are left out", "mm"),
    "plane_gap_mm": CheckWords("gap to the table (negative: sunk in)", "mm"),
    "penetration_mm": CheckWords("sunk into a neighbour", "mm"),
    "wrong_surface": CheckWords("surface in the wrong place", "%", 100),
    "views": CheckWords("views that see it"),
    "n_pixels": CheckWords("pixels compared"),
}
"""What decides most often, in the order of the table."""


def verdict_rgb(verdict: str) -> tuple[int, int, int]:
    """Return the colour of a verdict, so dark that white letters can be read on it."""
    rgb = np.array(VERDICT_RGB.get(verdict, VERDICT_RGB["unchecked"]), dtype=np.float64)
    while 1.05 / (_luminance(rgb) + 0.05) < LEAST_CONTRAST:
        rgb *= 0.97
    r, g, b = (int(c) for c in rgb)
    return r, g, b


def _luminance(rgb: Array) -> float:
    """Return the relative luminance of an sRGB colour, white = 1 (WCAG 2.1)."""
    return float(luminance(light_of_bytes(rgb)))


def color_dot(verdict: str) -> str:
    """Return a coloured dot for a verdict."""
    return f'<span style="color:rgb{verdict_rgb(verdict)}">&#9679;</span>'


def object_text(
    shown: ObjectPose,
    corrected: ObjectPose,
    model: ObjectModel,
    decision: Entry | None,
    missing: str = "",
) -> str:
    """Return the head of an object's panel: what was computed, and what a person said of it.

    Args:
        shown: with the reviewers' verdict.
        corrected: where the reviewers left it, with the computed verdict.
        model: its model.
        decision: the last standing accept or reject; None = nobody has judged it.
        missing: what is to be done about its model, which is not there; '' = it is.
    """
    lines = [f"### {escaped(model.name)}", f"instance {shown.instance}, object {shown.obj_id}", ""]
    if missing:
        said = f"Its model is missing; drawn is the one that it was registered as. {missing}"
        lines += [f'<span style="color:{ALARM}">{escaped(said)}</span>', ""]
    lines.append(f"{color_dot(corrected.verdict)} computed: **{corrected.verdict}**")
    lines += [f"- {escaped(reason)}" for reason in corrected.reasons]
    lines.append("")
    if decision is None:
        lines.append("nobody has judged it yet")
    else:
        word = ACTION_WORDS[decision.action]
        lines.append(f"{color_dot(shown.verdict)} **{word}** by {signed(decision)}")
        if decision.comment:
            lines.append(f"> {escaped(decision.comment)}")
    return "\n".join(lines)


def certainty_text(placed: ObjectPose, model: ObjectModel) -> str:
    """Return how sure the pose is: probability, sigma in mm and in degrees."""
    lines: list[str] = []
    probability = placed.checks.get("probability")
    if probability is not None and np.isfinite(probability):
        lines.append(f"- right with a probability of {percent(probability)}")
    sure = pose_sigmas(placed, model)
    if sure is None:
        lines.append("- how sure the pose is, is not known: nothing was computed of it")
        return "\n".join(lines)
    lines.append(f"- 1 sigma of the position: {1e3 * sure.position_m:.2g} mm along its worst axis")
    lines.append(f"- 1 sigma of the turn: {sure.words}")
    return "\n".join(lines)


def checks_table(placed: ObjectPose, *, main: bool) -> str:
    """Return the table of the checks that decide, or of all the others."""
    rows: list[str] = []
    if main:
        for name, shown in MAIN_CHECKS.items():
            if name in placed.checks:
                rows.append(f"| {shown.words} | {figure(placed.checks[name], shown)} |")
    else:
        rest = {k: v for k, v in placed.checks.items() if k not in MAIN_CHECKS}
        for name, value in rest.items():
            rows.append(f"| {escaped(name)} | {value:.4g} |")
    if not rows:
        return "nothing was measured" if main else ""
    return "\n".join(["| check | value |", "|:--|--:|", *rows])


def figure(value: float, shown: CheckWords) -> str:
    """Return a check's value with its unit."""
    if not np.isfinite(value):
        return "not measured"
    scaled = shown.scale * value
    if shown.unit == "%":
        return percent(value)
    if not shown.unit:
        return f"{scaled:,.0f}"
    return f"{scaled:.2g} {shown.unit}" if abs(scaled) < 100 else f"{scaled:.0f} {shown.unit}"


def percent(share: float) -> str:
    """Return a share as per cent; 100 % only where nothing is missing."""
    value = 100.0 * share
    if value >= 100.0 or value <= 0.0:
        return f"{value:.0f} %"
    return f"{min(value, 99.99):.2f} %" if value > 99.0 else f"{value:.1f} %"


def history_text(entries: Sequence[Entry]) -> str:
    """Return the standing lines on an object, the newest first."""
    if not entries:
        return "no lines in the journal"
    lines: list[str] = []
    for entry in reversed(entries):
        word = ACTION_WORDS.get(entry.action, entry.action)
        how = f" ({escaped(entry.how)})" if entry.how else ""
        line = f"- {clock(entry)} **{escaped(entry.reviewer)}** {word}{how}"
        lines.append(f"{line}: {escaped(entry.comment)}" if entry.comment else line)
    return "\n".join(lines)


def undo_label(last: Entry | None) -> str:
    """Return what the undo button says: whose line it takes back."""
    if last is None:
        return "Undo"
    return f"Undo: {one_line(last.reviewer)} {ACTION_WORDS.get(last.action, last.action)}"[:48]


def signed(entry: Entry) -> str:
    """Return who wrote a line, and when."""
    return f"{escaped(entry.reviewer)}, {clock(entry)}"


def clock(entry: Entry) -> str:
    """Return when a line was written, to the minute, in UTC."""
    return f"{escaped(entry.time[:10])} {escaped(entry.time[11:16])} UTC"


def list_label(row: ObjectRow, scene: str, *, with_scene: bool) -> str:
    """Return the two lines of an object in the list: what it is, and what is said of it."""
    what = [f"{row.instance} {row.name}"]
    if with_scene:
        what.append(scene)
    moved = ["moved"] if row.is_changed else []
    if row.is_decided:
        mark = "\u2717" if row.verdict == "rejected" else "\u2713"
        said = [f"{mark} {row.verdict} by a person", *moved]
    else:
        said = [f"computed: {row.verdict}", *moved]
        if np.isfinite(row.agree):
            said.append(f"fits {100 * row.agree:.0f} %")
    return "\n".join(one_line(" \u00b7 ".join(parts)) for parts in (what, said))


def progress_html(judged: int, total: int, scenes: int, others: Sequence[str] = ()) -> str:
    """Return how far the review has come, in words and as a bar, and what others look at."""
    more = f" in {scenes} scenes" if scenes > 1 else ""
    share = 100.0 * judged / max(total, 1)
    people = "".join(f"<div>\u25cf {html.escape(one_line(who))}</div>" for who in others)
    return (
        f'<div class="realsim-progress"><b>{judged} of {total}</b> objects judged{more}'
        f'<div><div style="width:{share:.1f}%"></div></div>{people}</div>'
    )


def legend_html(cells: Iterable[tuple[str, Sequence[int]]], words: str) -> str:
    """Return a row of cells (text, RGB) and what they mean."""
    row = "".join(
        f'<i style="background:rgb({r},{g},{b});color:{_ink(r, g, b)}">{html.escape(text)}</i>'
        for text, (r, g, b) in cells
    )
    return f'<div class="realsim-legend"><div>{row}</div>{html.escape(words)}</div>'


def _ink(r: int, g: int, b: int) -> str:
    """Return the colour of letters that can be read on this one."""
    return "#000" if 0.3 * r + 0.6 * g + 0.1 * b > 140 else "#fff"


def row_style(uuid: str, row: ObjectRow, *, is_here: bool) -> str:
    """Return the style of a list's button: a person's word is filled, a computed one an edge."""
    color = f"rgb{verdict_rgb(row.verdict)}"
    button = f"button[id='{uuid}']"
    frame = "outline:2px solid #ff7800;outline-offset:1px;" if is_here else ""
    if row.is_decided:
        return f"{button} {{ background:{color} !important; color:#fff !important; {frame} }}"
    return (
        f"{button} {{ background:#fff !important; color:#212529 !important; "
        f"border:1px solid #ced4da; border-left:6px dashed {color}; {frame} }}"
    )


def message_html(text: str, kind: str) -> str:
    """Return the line that answers the last thing done: kind is ok, refused or alarm."""
    return f'<div class="realsim-message {kind}">{html.escape(one_line(text))}</div>'


def symmetry_words(model: ObjectModel) -> str:
    """Return how a model is symmetric, in words."""
    words: list[str] = []
    if model.symmetry_axes:
        n = len(model.symmetry_axes)
        words.append("of revolution about an axis" if n == 1 else f"of revolution about {n} axes")
    if len(model.symmetries) > 1:
        words.append(f"looks the same in {len(model.symmetries)} positions")
    return ", ".join(words) or "not symmetric"
