"""Benchmark of the review as a person's tool: defects found, keys and seconds a defect.

    uv run python benchmarks/review_people.py [--quick] [--json FILE] [--seed N]

Seven scenes of nine objects (two with --quick) hold six defects each: a wrong place, a wrong
model, a wrong turn, a missing object, and two shifts of 3 mm. What the program computed says
nothing of them. A scripted reviewer in Chromium without a graphics card uses what the page shows:
it opens the photographs, reads how much of the worst view speaks against the pose, judges by a key,
and goes on to the next.

Figures: defects_found_share, false_alarms_share (of the right objects), seconds_per_defect,
keys_per_defect, console_errors.
"""

import json
import tempfile
import time
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import Any

import blas_threads  # noqa: F401
import numpy as np
from figures import Figure, Found, Goal, run
from labels_scene import scene as labels_scene
from review_page import chromium_page

from realsim.formats.bop.models import save_models
from realsim.geometry import camera, se3
from realsim.records import (
    CameraIntrinsics,
    CaptureSession,
    Mesh,
    ObjectModel,
    ObjectPose,
    Scene,
    SupportPlane,
    View,
)
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.review import ReviewServer
from realsim.review.content.config import SceneConfig
from realsim.store import SessionStore, save_scene

SCENES, QUICK_SCENES, MODELS, VIEWS = 7, 2, 6, 8
AGAINST = 8.0
"""A pose that more than this share of its pixels speaks against is rejected [%]."""
CAMERA = CameraIntrinsics(
    width=640, height=480, fx=600.0, fy=600.0, cx=319.5, cy=239.5,
    distortion=np.array([-0.05, 0.05, 0.0, 0.0, 0.0]),
)  # fmt: skip
LONGEST_S = 300.0
FEW = SceneConfig(coarse_points=4_000, shown_points=4_000, most_points=20_000)
"""So little that a processor draws the scene; the photographs are as they are."""
HERE = """(() => {
    const all = document.querySelector(".rs-photograph"); if (!all) return "";
    const said = all.querySelector(".rs-caption").innerText;
    return (all.dataset.whose || "") + " \u00b7 " + said; })()"""
"""Scene and object whose photographs are shown, its name, and what is said of the view."""
CIRCLES = "document.querySelector('.rs-pane')?.dataset.missing"
FIGURES = {
    "defects_found_share": Figure(unit="", goal=Goal(low=0.95)),
    "false_alarms_share": Figure(unit="", goal=Goal(high=0.05)),
    "seconds_per_defect": Figure(unit="s"),
    "keys_per_defect": Figure(unit=""),
    "console_errors": Figure(unit="", goal=Goal(high=0.0)),
}


def models(rng: np.random.Generator) -> dict[int, ObjectModel]:
    """Return brackets of two boxes: none looks alike after a turn, or like another."""
    import trimesh

    found: dict[int, ObjectModel] = {}
    for k in range(1, MODELS + 1):
        foot, wall = rng.uniform([0.04, 0.02, 0.01], [0.06, 0.035, 0.018]), rng.uniform(0.02, 0.045)
        parts = [trimesh.creation.box(foot), trimesh.creation.box([0.014, foot[1], wall])]
        parts[1].apply_translation([0.5 * foot[0] - 0.007, 0, 0.5 * (foot[2] + wall)])
        whole: Any = trimesh.util.concatenate(parts)
        vertices = np.add(whole.vertices, [0, 0, 0.5 * foot[2]])
        mesh = Mesh(vertices=vertices, faces=np.asarray(whole.faces, np.int32))
        found[k] = ObjectModel(obj_id=k, name=f"bracket {k}", mesh=mesh)
    return found


def seeded(folder: Path, known: dict[int, ObjectModel], rng: np.random.Generator) -> dict[str, Any]:
    """Write a scene whose labels have defects; return which instances, and where one is missing."""
    turns = rng.uniform(0, 6.28, 9)
    Ts = [se3.from_rt(se3.exp_so3([0, 0, a]), [0.11 * (k % 3 - 1), 0.11 * (k // 3 - 1), 0])
          for k, a in enumerate(turns)]  # fmt: skip
    true = [ObjectPose(obj_id=int(i), instance=k, verdict="accepted", T_world_obj=Ts[k])
            for k, i in enumerate(rng.integers(1, MODELS + 1, 9))]  # fmt: skip
    session = CaptureSession(name=folder.name, intrinsics=CAMERA, views=(), depth_unit_m=1e-4)
    store = SessionStore.create(folder, session)
    placed = [PlacedMesh(o.instance, known[o.obj_id].mesh, o.T_world_obj) for o in true]
    renderer = LabelRenderer([labels_scene()[0], *placed])
    colors = rng.integers(60, 220, (len(true) + 1, 3))
    for index in range(VIEWS):
        a = 2 * np.pi * index / VIEWS
        T = se3.look_at([0.42 * np.cos(a), 0.42 * np.sin(a), 0.42], [0, 0, 0.01])
        labels = renderer.render(CAMERA, T)
        shade = np.abs(labels.normals() @ [0.3, 0.4, -0.85])[..., None]
        rgb = np.clip(colors[labels.ids + 1] * shade + rng.normal(0, 4, (480, 640, 3)), 0, 255)
        depth = labels.depth_m + rng.normal(0, 5e-4, labels.depth_m.shape) * (labels.depth_m > 0)
        view = View(index=index, T_world_cam=T)
        store.add_view(view, rgb.astype(np.uint8), depth.astype(np.float32))
    save_models(store.folder / "models", known)
    place, swap, turn, missing, *small = rng.permutation(9)[:6].tolist()

    def moved(k: int, by: list[float], deg: float = 0.0) -> ObjectPose:
        spin = se3.from_rt(se3.exp_so3([0, 0, np.radians(deg)]), [0, 0, 0])
        return replace(true[k], T_world_obj=se3.from_translation(by) @ true[k].T_world_obj @ spin)

    wrong = {place: moved(place, [0.02, -0.015, 0], 60), turn: moved(turn, [0, 0, 0], 180),
             swap: replace(true[swap], obj_id=true[swap].obj_id % MODELS + 1)}  # fmt: skip
    for k, a in zip(small, turns, strict=False):
        wrong[k] = moved(k, [0.003 * np.cos(a), 0.003 * np.sin(a), 0])
    said = tuple(wrong.get(o.instance, o) for o in true if o.instance != missing)
    save_scene(store, Scene(name=folder.name, objects=said,
                            plane=SupportPlane(T_world_table=np.eye(4))))  # fmt: skip
    store.close()
    return {"wrong": set(wrong), "at": true[missing].T_world_obj[:3, 3] + [0, 0, 0.01]}


def people(arguments: Namespace) -> Found:
    """Have a scripted reviewer judge the scenes."""
    found, rng = Found(), np.random.default_rng(arguments.seed)
    known = models(rng)
    with tempfile.TemporaryDirectory(prefix="review_people_") as scratch:
        names = [f"table_{k}" for k in range(QUICK_SCENES if arguments.quick else SCENES)]
        truth = {n: seeded(Path(scratch) / n, known, rng) for n in names}
        server = ReviewServer([SessionStore.open(Path(scratch) / n) for n in names], port=0,
                              reviewer="script", config=FEW)  # fmt: skip
        server.start()
        try:
            with chromium_page(server.url) as (page, errors):
                keys, seconds, circles = _review(page, names)
        finally:
            server.stop()
        said = {s.name: s.latest.state.entries for s in server.sessions}
        views = {s.name: s.store.session for s in server.sessions}
    hits, alarms, right = 0, 0, 0
    for name, t in truth.items():
        rejected = {e.instance for e in said[name] if e.action == "reject"}
        alarms += len(rejected - t["wrong"])
        right += len({e.instance for e in said[name]} - t["wrong"])
        hits += len(rejected & t["wrong"])
        hits += any(_circled(views[name], v, spots, t["at"]) for v, spots in circles[name])
    total = 6 * len(names)
    over = f"{total} defects in {len(names)} scenes of 8 drawn objects"
    found.add("defects_found_share", hits / total, over)
    found.add("false_alarms_share", alarms / max(right, 1), f"{alarms} of {right} right objects")
    found.add("seconds_per_defect", seconds / max(hits, 1), "opening of the scenes included")
    found.add("keys_per_defect", keys / max(hits, 1))
    found.add("console_errors", len(errors), "; ".join(errors)[:300])
    return found


def _review(page: Any, names: list[str]) -> tuple[int, float, dict[str, list[Any]]]:
    """Judge every object by what the photographs show; return keys, seconds, circles."""
    circles: dict[str, list[Any]] = {n: [] for n in names}
    start, keys, before = time.perf_counter(), 1, ""
    page.keyboard.press("g")
    for _ in range(8 * len(names)):
        # After a judgement an object's own views are compared again: that is not the next one.
        _until(page, lambda b=before: _here(page).split(" \u00b7 ")[0] not in ("", b))
        before, _, of_view, against, *_ = _here(page).split(" \u00b7 ")
        view, share = int(of_view.split()[1]), float(against.split()[0])
        scene = names[int(before.split("/")[0])]
        _until(page, lambda: page.evaluate(CIRCLES) is not None)
        circles[scene].append((view, json.loads(page.evaluate(CIRCLES))))
        page.keyboard.press("x" if share > AGAINST else "y")
        page.wait_for_timeout(50)
        page.keyboard.press("n")
        keys += 2
    _until(page, lambda: "All objects are judged" in page.evaluate("document.body.innerText"))
    return keys, time.perf_counter() - start, circles


def _here(page: Any) -> str:
    return page.evaluate(HERE)


def _until(page: Any, holds: Any) -> None:
    end = time.perf_counter() + LONGEST_S
    while not holds():
        if time.perf_counter() > end:
            raise RuntimeError(f"waited in vain; the page shows: {_here(page)}")
        page.wait_for_timeout(30)


def _circled(session: Any, view: int, spots: list[list[float]], at: Any) -> bool:
    """Return whether one of the circles (u, v, radius) in a view is about a point (3,)."""
    T = session.view(view).T_world_cam
    u, v = camera.project(CAMERA, se3.transform(se3.invert(T), at[None]))[0]
    return any(np.hypot(s[0] - u, s[1] - v) < s[2] + 5 for s in spots)


if __name__ == "__main__":
    packages = ("realsim", "numpy", "viser", "playwright")
    run("review_people", str(__doc__), packages, FIGURES, {"people": people})
