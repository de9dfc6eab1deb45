"""What is measured on a scene: registration from every kind of start, refined and judged.

Imported by the registration benchmark. Each function returns rows and samples for the figures.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from registration_cases import SceneKey, library, make_scene, starts_of, stream
from registration_errors import camera_errors, image_errors_px, rows_of, rows_of_unknown
from registration_figures import LOST_MM, Done, Row

from realsim.records import ObjectModel, ObjectPose
from realsim.registration.config import RegistrationConfig
from realsim.registration.intake import take_in
from realsim.registration.register import Registration, register_scene
from realsim.registration.search.find import find_objects
from realsim.registration.search.records import Wanted
from realsim.registration.simulated import TableScene

ABSENT = 4
"""Models that are wanted and not in the scene."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Given:
    """A scene and what is known of it."""

    key: SceneKey
    scene: TableScene
    models: Mapping[int, ObjectModel]
    """All 30."""
    config: RegistrationConfig


def given(key: SceneKey, keep: Path | None) -> Given:
    """Return a scene with what registration is told."""
    folder = None if keep is None else keep / "fields"
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    config = RegistrationConfig(field_folder=folder, with_single_view=False)
    return Given(key=key, scene=make_scene(key, keep), models=library(keep), config=config)


def wanted_of(scene: TableScene) -> list[Wanted]:
    """Return the objects by their ids, nothing said of where they are."""
    return [Wanted(obj_id=p.obj_id, instance=p.instance) for p in scene.truth]


def registered(
    g: Given, wanted: Sequence[ObjectPose] | Sequence[Wanted] | None
) -> tuple[Registration, float]:
    """Return the registration of a scene and its CPU time [s]."""
    began = time.process_time()
    found = register_scene(
        f"{g.key.seed}", g.scene.intrinsics, g.scene.frames, g.models, wanted, g.config
    )
    return found, time.process_time() - began


def _timed(key: str, seconds: float) -> dict[str, list[float]]:
    return {f"cpu_s_{key}": [seconds]}


def rough(g: Given) -> Done:
    """Register from rough starts."""
    found, cpu_s = registered(g, starts_of(g.scene, g.key.seed, "rough"))
    rows = rows_of("rough", g.key.seed, g.scene, found.scene.objects)
    return Done(rows=tuple(rows), samples=_timed("rough", cpu_s))


def cold(g: Given) -> Done:
    """Register from nothing, ids given."""
    found, cpu_s = registered(g, wanted_of(g.scene))
    part = "piles" if g.key.pile else "cold"
    rows = rows_of(part, g.key.seed, g.scene, found.scene.objects)
    return Done(rows=tuple(rows), samples=_timed(part, cpu_s))


def unknown(g: Given) -> Done:
    """Find out which of all models are there, and where."""
    found, cpu_s = registered(g, None)
    kept = [p for p in found.scene.objects if p.verdict != "rejected"]
    rows = rows_of_unknown("unknown", g.key.seed, g.scene, kept, g.models)
    return Done(rows=tuple(rows), samples=_timed("unknown", cpu_s))


def absent(g: Given) -> Done:
    """Ask for models that are not there as well: none of them may be accepted."""
    there = {p.obj_id for p in g.scene.truth}
    missing = sorted(set(g.models) - there)
    picked = stream(g.key.seed, "absent").choice(missing, ABSENT, replace=False)
    first = max(p.instance for p in g.scene.truth) + 1
    extra = [Wanted(obj_id=int(i), instance=first + n) for n, i in enumerate(picked)]
    found, _ = registered(g, [*wanted_of(g.scene), *extra])
    by = {p.instance: p for p in found.scene.objects}
    rows: list[Row] = []
    for w in extra:
        pose = by.get(w.instance)
        rows.append(
            Row(seed=g.key.seed, part="absent", name=g.models[w.obj_id].name,
                verdict="not placed" if pose is None else pose.verdict,
                said={} if pose is None else {"checks": dict(pose.checks)})
        )  # fmt: skip
    return Done(rows=tuple(rows))


def refined(g: Given) -> Done:
    """Register from nothing with many views; compare with the cameras at their word."""
    part = "biased" if g.key.bias_px else "refined"
    prefix = "biased_" if g.key.bias_px else ""
    found, cpu_s = registered(g, wanted_of(g.scene))
    rows = rows_of(part, g.key.seed, g.scene, found.scene.objects, with_adds=True)
    mm, deg = camera_errors(g.scene, found.cameras)
    samples: dict[str, list[float]] = {
        f"{prefix}px_after": image_errors_px(g.scene, found.scene.objects, found.cameras),
        f"{prefix}camera_mm_after": mm,
        f"{prefix}camera_deg_after": deg,
        **_timed(f"{part}_640px", cpu_s),
    }
    if not prefix:
        samples |= _before(g)
    notes = _said(g, found)
    return Done(rows=tuple(rows), samples=samples, notes=notes)


def _before(g: Given) -> dict[str, list[float]]:
    """Return how far off images and cameras are as claimed, with the objects of the search."""
    intake = take_in(g.scene.intrinsics, g.scene.frames, g.config)
    assert intake.plane is not None, "the simulated table is found"
    result = find_objects(
        intake.intrinsics, intake.frames, intake.views, intake.plane, intake.noise, g.models,
        wanted_of(g.scene), g.config.find, field_folder=g.config.field_folder,
    )  # fmt: skip
    poses = [
        ObjectPose(obj_id=p.obj_id, instance=p.instance, T_world_obj=p.T_world_obj)
        for p in result.placed
    ]
    claimed = {f.index: f.T_world_cam for f in g.scene.frames}
    mm, deg = camera_errors(g.scene, claimed)
    return {
        "px_before": image_errors_px(g.scene, poses, claimed),
        "camera_mm_before": mm,
        "camera_deg_before": deg,
    }


def _said(g: Given, found: Registration) -> tuple[str, ...]:
    """Return what the registration found of cameras and depth, and every finding."""
    r: Any = found.report.get("refinement", {})
    head = (
        f"seed {g.key.seed}, {g.key.views} views, bias {g.key.bias_px:g} px: hand-eye moved by "
        f"{r.get('hand_eye_mm', np.nan):.3f} mm / {r.get('hand_eye_deg', np.nan):.4f} deg, "
        f"depth scale {r.get('depth_scale', np.nan):.5f}, offset "
        f"{r.get('depth_offset_per_m', np.nan):.5f} 1/m; views' own "
        f"{r.get('view_sigma_mm', np.nan):.3f} mm / {r.get('view_sigma_deg', np.nan):.4f} deg"
    )
    return (head, *(f"seed {g.key.seed}: {f.words}" for f in found.findings))


def lost_rows(parts: Sequence[str], seed: int, count: int, failure: str) -> tuple[Row, ...]:
    """Return rows of parts that failed as a whole: all their objects are lost."""
    return tuple(
        Row(seed=seed, part=part, name="?", mssd_mm=LOST_MM, verdict="failed", failure=failure)
        for part in parts for _ in range(count)
    )  # fmt: skip
