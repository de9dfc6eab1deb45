"""A reviewed scene as one HTML file that opens from the disk: no server, no network.

    write_static(SceneContent.load(store, SceneConfig()), state, "scene.html", title="Table 3")

The scene is viser's own page, in a frame; beside it stands a panel with the objects, worst first,
what the reviewers said of them, and what is shown. A policy in the page forbids the browser to
load anything from anywhere, so that nothing in it can.

The words of the static page.
"""

import html
import json
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from realsim import __version__
from realsim.arrays import Array, evenly
from realsim.errors import InputError
from realsim.formats.bop.models import model_file
from realsim.geometry import se3
from realsim.pages.page import Page, counted, template
from realsim.pages.pictures import data_url
from realsim.records import GraspSet, ObjectModel, ObjectPose, Scene
from realsim.records.grasps import label_words
from realsim.rendering.overlay import VERDICT_RGB
from realsim.review.content.content import SceneContent
from realsim.review.content.views import worst_first
from realsim.review.corrections import DECIDED, corrected_scene, decision_on, reviewed_scene
from realsim.review.journal import Entry, ReviewState
from realsim.review.placing.ellipsoid import pose_sigmas
from realsim.review.replaying.grasp_words import one_line
from realsim.review.scene_list import VERDICT_ORDER
from realsim.review.static.page_nodes import (
    LABEL_EDGES,
    StaticSize,
    drawn_grasps,
    label_class,
    viewer_html,
)

NOT_KNOWN = "not known"


def counts_words(content: SceneContent, scene: Scene, state: ReviewState) -> str:
    """Return the line under the title: scene, verdicts, reviewers, views."""
    found = {v: sum(o.verdict == v for o in scene.objects) for v in VERDICT_ORDER}
    verdicts = ", ".join(f"{n} {v}" for v, n in found.items() if n)
    count = counted(len(scene.objects), "object")
    words = [scene.name, f"{count}: {verdicts}" if verdicts else count]
    words.append(counted(len(content.views), "view"))
    excluded = len(state.excluded_views())
    if excluded:
        words[-1] += f" ({excluded} left out by the reviewers)"
    names = sorted({one_line(e.reviewer) for e in state.standing})
    words.append(f"reviewed by {', '.join(names)}" if names else "not reviewed yet")
    return "; ".join(w for w in words if w) + "."


def object_rows(content: SceneContent, scene: Scene, state: ReviewState) -> list[dict[str, Any]]:
    """Return what the list says of the objects, worst first."""
    corrected = corrected_scene(content.scene, state)
    sets = {g.instance: g for g in content.grasp_sets}
    rows: list[dict[str, Any]] = []
    for placed in worst_first(scene.objects):
        model, was = content.models[placed.obj_id], corrected.object(placed.instance)
        lines = [*_judged(was, decision_on(was, state)), *was.reasons]
        quotes = [
            (_said(e.comment), _said(f"{e.reviewer}, {e.time[:10]}"))
            for e in state.of(placed.instance)
            if e.comment.strip()
        ]
        rows.append({
            "instance": placed.instance, "name": _said(model.name), "verdict": placed.verdict,
            "color": "#{:02x}{:02x}{:02x}".format(*VERDICT_RGB[placed.verdict]),
            "lines": [_said(line) for line in lines], "quotes": quotes,
            "rows": _table(placed, was, model, sets.get(placed.instance)),
        })  # fmt: skip
    return rows


def _judged(corrected: ObjectPose, decision: Entry | None) -> list[str]:
    """Return who judged, and what the program had computed."""
    if decision is None:
        return [f"computed: {corrected.verdict}; judged by nobody"]
    said = f"{DECIDED[decision.action]} by {decision.reviewer}, {decision.time[:10]}"
    return [said, f"computed: {corrected.verdict}"]


def _table(
    placed: ObjectPose, corrected: ObjectPose, model: ObjectModel, grasps: GraspSet | None
) -> list[tuple[str, str]]:
    rows = [("instance", str(placed.instance)), ("object id", str(placed.obj_id))]
    rows += sigma_rows(corrected, model)
    agree = corrected.checks.get("agree")
    if agree is not None and np.isfinite(agree):
        rows.append(("pixels that agree with the depth", f"{100 * agree:.1f} %"))
    if grasps is not None and len(grasps):
        rows.append(("grasps, good of all", f"{int(grasps.good.sum())} of {len(grasps)}"))
    return rows


def sigma_rows(placed: ObjectPose, model: ObjectModel) -> list[tuple[str, str]]:
    """Return how sure position and turn are: words and figures."""
    sure = pose_sigmas(placed, model)
    if sure is None:
        return [("1 sigma of the pose", NOT_KNOWN)]
    rows = [("1 sigma, position", f"{1e3 * sure.position_m:.2g} mm")]
    if sure.sigmas_deg:
        rows.append(("1 sigma, turn", f"{max(sure.sigmas_deg):.2g} deg"))
    return rows


def _said(text: str) -> str:
    return one_line(text).strip()


Progress = Callable[[int, int], None]
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; "
    "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; connect-src data: blob:; "
    "worker-src blob: data:; frame-src 'self'; form-action 'none'; base-uri 'none'"
)
"""What the browser may load: what is in the file, and nothing else. Viser unpacks its program and
its decoder from the page itself, for which it needs `eval` and addresses of the kind blob and
data."""
TRIES = 6
"""How often the scene is halved to fit; 64 times smaller is no scene."""
ASIDE_M = 0.25
"""How far before a camera the point is that one looks at from it [m]."""
MADE_WITH = (
    "Made with realsim {version} (Apache-2.0). The viewer in this file is Viser (Apache-2.0) with "
    "three.js (MIT)."
)


@dataclass(frozen=True, kw_only=True, slots=True)
class PageWords:
    """What a person adds to a static page."""

    caption: str = ""
    """A few words below the title, as under a figure."""
    licence: str = ""
    """On what terms the data may be used; '' = nothing is said of it."""
    made: datetime | None = None
    """The date on the page, with its time zone; None = now."""


@dataclass(frozen=True, kw_only=True, slots=True)
class StaticSummary:
    """What a static page came out as."""

    path: Path
    size_bytes: int
    points: int
    """Points of the cloud in the file."""
    points_in_all: int
    cameras: int
    cameras_in_all: int
    grasps: int
    grasps_in_all: int
    texels: int
    """Longest side of a texture [px]."""


def write_static(
    content: SceneContent,
    state: ReviewState,
    path: Path | str,
    *,
    title: str,
    words: PageWords | None = None,
    most_points: int = 300_000,
    most_bytes: float = 25e6,
    progress: Progress = lambda done, of: None,
) -> StaticSummary:
    """Write a reviewed scene as one HTML file.

    What is too large is drawn with less: fewer points, cameras and grasps, smaller textures.

    Args:
        content: the session.
        state: what its journal adds up to.
        path: the file; its folder must exist.
        title: of the page.
        words: caption, licence and date.
        most_points: points of the cloud.
        most_bytes: of the file.
        progress: called with (steps done, steps).

    Raises:
        InputError: the title is empty, the file cannot be made there, a model is missing, or the
            scene cannot be made small enough.
    """
    from realsim.store import atomic

    path = Path(path)
    _check(path, title, most_points, most_bytes)
    scene = reviewed_scene(content.scene, state)
    _check_models(content, scene)
    size, page = StaticSize(points=most_points), b""
    for tried in range(TRIES):
        progress(tried, TRIES + 1)
        size = size.smaller() if tried else size
        page = _page(content, scene, state, size, title, words or PageWords())
        if len(page) <= most_bytes:
            break
    if len(page) > most_bytes:
        raise InputError(
            f"the scene cannot be made smaller than {len(page) / 1e6:.1f} MB; a file of "
            f"{most_bytes / 1e6:.1f} MB was asked for. The viewer alone needs 1 MB; allow more."
        )
    atomic.write_bytes(path, page)
    progress(TRIES + 1, TRIES + 1)
    return _summary(content, size, path, len(page))


def check_page_path(path: Path) -> None:
    """Check that a page can be made there, before anything is read for it.

    Raises:
        InputError: its folder is not there, or it is a folder itself.
    """
    real = path.absolute()
    if real.is_dir():
        raise InputError(
            f"'{path}' ({real}) is a folder; the page is one file: give its name, such as "
            f"{path / 'scene.html'}."
        )
    if not real.parent.is_dir():
        raise InputError(
            f"the folder '{path.parent}' ({real.parent}) for the page is not there; make it first."
        )


def _check_models(content: SceneContent, scene: Scene) -> None:
    """Raise if an object cannot be drawn: a swap may name one that has no model here."""
    folder = content.store.folder / "models"
    missing = [
        f"instance {o.instance} was said to be object {o.obj_id}, but "
        f"{folder / model_file(o.obj_id)} is not there"
        for o in scene.objects
        if o.obj_id not in content.models
    ]
    if missing:
        raise InputError(
            f"{'; '.join(missing)}. Copy it there, or undo the swap in `realsim review`."
        )


def _check(path: Path, title: str, most_points: int, most_bytes: float) -> None:
    """Raise if the page cannot be written."""
    if not title.strip():
        raise InputError("the page has no title; give it one: it is what a reader sees first.")
    check_page_path(path)
    if most_points < 1 or not most_bytes > 0:
        raise InputError(
            f"{most_points} points in {most_bytes:g} bytes were asked for; both must be positive."
        )


def _page(
    content: SceneContent,
    scene: Scene,
    state: ReviewState,
    size: StaticSize,
    title: str,
    words: PageWords,
) -> bytes:
    """Return the page's bytes."""
    script = files("realsim.review.static").joinpath("static_page.js").read_text("utf-8")
    sets = content.grasp_sets
    text = template("static_page.html", package="realsim.review.static").render(
        page=Page(), policy=Markup(html.escape(POLICY)), version=__version__, title=title.strip(),
        caption=words.caption.strip(), about=counts_words(content, scene, state),
        objects=object_rows(content, scene, state),
        photos=[(v.index, data_url(content.thumbnails[v.index])) for v in _cameras(content, size)
                if v.index in content.thumbnails],
        left_out=state.excluded_views(), footer=_footer(content, size, words),
        label=label_words(sets) if any(len(g) for g in sets) else "",
        pale="; pale: p_hold of few draws" * any(g.unsure.any() for g in sets),
        last_class=len(LABEL_EDGES) - 1,
        viewer=Markup(html.escape(viewer_html(content, scene, size), quote=True)),
        data=Markup(_json(_data(content, scene, size))), script=Markup(script),
    )  # fmt: skip
    return text.encode()


def _cameras(content: SceneContent, size: StaticSize) -> list[Any]:
    """Return the views that are drawn."""
    return evenly(content.shown_views, size.cameras)


def _data(content: SceneContent, scene: Scene, size: StaticSize) -> dict[str, Any]:
    """Return what the page's script must know."""
    look = content.look
    away = look.position - look.look_at
    distance = float(np.linalg.norm(away))
    across = away - look.up * float(look.up @ away)
    objects: list[dict[str, Any]] = []
    for placed in scene.objects:
        middle, diagonal = _middle(placed, content.models[placed.obj_id])
        objects.append({"instance": placed.instance, "middle": _short(middle), "size": diagonal})
    cameras: list[dict[str, Any]] = []
    for view in _cameras(content, size):
        T = np.asarray(view.T_world_cam)
        target = T[:3, 3] + ASIDE_M * T[:3, 2]
        cameras.append({"view": view.index, "position": _short(T[:3, 3]), "target": _short(target)})
    grasps = [
        [g.instance, k]
        for g in content.grasp_sets
        for k in sorted(set(label_class(g.labels)[drawn_grasps(g, size.grasps)].tolist()))
    ]
    # A camera exactly above has no way up; a hundredth beside it has.
    top = look.look_at + distance * (look.up + 0.01 * across / max(distance, 1e-9))
    return {
        "objects": objects,
        "cameras": cameras,
        "grasps": grasps,
        "edges": LABEL_EDGES,
        "cloud": len(content.cloud) > 0,
        "table": scene.plane is not None,
        "nodes": [f"/objects/{o.instance}" for o in scene.objects]
        + [f"/grasps/{i}/{k}" for i, k in grasps],
        "look": {
            "position": _short(look.position),
            "target": _short(look.look_at),
            "top": _short(top),
            "back": _short(look.position - 2.0 * across),
        },
    }


def _middle(placed: ObjectPose, model: ObjectModel) -> tuple[Array, float]:
    """Return the middle (3,) of an object in world and its diagonal [m]."""
    low, high = model.mesh.bounds
    middle = se3.transform(placed.T_world_obj, (low + high)[None] / 2.0)[0]
    return middle, float(np.linalg.norm(high - low))


def _short(values: Array) -> list[float]:
    """Return numbers to the micrometre: the page need not carry more."""
    return [round(float(v), 6) for v in values]


def _json(data: dict[str, Any]) -> str:
    """Return JSON that no HTML parser takes for the end of its script."""
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")


def _footer(content: SceneContent, size: StaticSize, words: PageWords) -> list[str]:
    made, licence = words.made or datetime.now(UTC), words.licence.strip()
    found = _summary(content, size, Path(), 0)
    return [
        f"Drawn: {found.points:,} of {found.points_in_all:,} points, {found.cameras} of "
        f"{found.cameras_in_all} cameras, {found.grasps} of {found.grasps_in_all} grasps.",
        *[f"The images of view {k} could not be read." for k in sorted(content.damaged)],
        f"{made.astimezone(UTC):%Y-%m-%d %H:%M} UTC",
        *([f"Data: {licence}"] if licence else []),
        MADE_WITH.format(version=__version__),
    ]


def _summary(content: SceneContent, size: StaticSize, path: Path, count: int) -> StaticSummary:
    return StaticSummary(
        path=path,
        size_bytes=count,
        points=min(size.points, len(content.cloud)),
        points_in_all=len(content.cloud),
        cameras=len(_cameras(content, size)),
        cameras_in_all=len(content.views),
        grasps=sum(min(len(g), size.grasps) for g in content.grasp_sets),
        grasps_in_all=sum(len(g) for g in content.grasp_sets),
        texels=size.texels,
    )
