"""Outlines in the photographs before and after registration, for sliders in the report.

Before: the poses that registration started from, through the cameras as robot and calibration
claim them. After: the registered poses, through the refined cameras. A pose or a camera that
registration did not change is the same in both.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from realsim.app.register.inputs import STARTS_FILE
from realsim.app.register.results import claimed_cameras, is_same_pose
from realsim.app.stages import registered_views, session_models
from realsim.arrays import Array, UInt8, evenly
from realsim.geometry import se3
from realsim.pages import View
from realsim.rendering.rays import PlacedMesh
from realsim.store import SessionStore

VIEWS = 3
"""Sliders in a report, spread over the session."""


def registration_pairs(store: SessionStore) -> tuple[list[View], str]:
    """Return before/after pairs of registered views, and in words what 'before' is.

    Both are empty where nothing tells what was before: no rough poses, no camera refined.

    Args:
        store: a session with a registered scene.
    """
    from realsim.store import load_scene

    scene, models = load_scene(store), session_models(store)
    after = [o for o in scene.objects if o.obj_id in models]
    started = _starts(store)
    claimed = claimed_cameras(store)
    told = registered_views(store)
    cameras = store.session.Ts_world_cam
    seen = [k for k in cameras if k in claimed and k in told]
    moved = [o for o in after if o.instance in started]
    refined = [k for k in seen if not is_same_pose(claimed[k], cameras[k])]
    if not seen or not after or not (moved or refined):
        return [], ""
    what: list[str] = []
    if moved:
        what.append(f"{len(moved)} of {len(after)} objects at the rough pose they started from")
    if refined:
        what.append(f"{len(refined)} of {len(seen)} cameras as robot and calibration claim them")
    kept = [PlacedMesh(o.instance, models[o.obj_id].mesh, o.T_world_obj) for o in after]
    before = [replace(p, T_world_obj=started.get(p.instance, p.T_world_obj)) for p in kept]
    pairs: list[View] = []
    for k in evenly(seen, VIEWS):
        pictures = {
            "before": _outlined(store, k, claimed[k], before),
            "registered": _outlined(store, k, cameras[k], kept),
        }
        pairs.append(View(f"view {k}", pictures))
    return pairs, f"Before: {', and '.join(what)}."


def _starts(store: SessionStore) -> dict[int, Array]:
    """Return the rough pose of every instance that was given one as a pose.

    Clicks, boxes and masks are no poses; they are left out.
    """
    told: Any = store.read_json(STARTS_FILE) if store.has(STARTS_FILE) else {}
    rows: list[Any] = told.get("starts", []) if isinstance(told, dict) else []
    found = [r for r in rows if isinstance(r, dict) and {"instance", "T_world_obj"} <= r.keys()]
    return {int(r["instance"]): se3.check_rigid(r["T_world_obj"], STARTS_FILE) for r in found}


def _outlined(
    store: SessionStore, index: int, T_world_cam: Array, placed: Sequence[PlacedMesh]
) -> UInt8:
    """Return a photograph with the outlines of objects at given poses, by instance colours."""
    from realsim.rendering.labels import LabelRenderer
    from realsim.rendering.overlay import draw_outlines

    ids = LabelRenderer(placed).render(store.session.intrinsics, T_world_cam).ids
    return draw_outlines(store.rgb(index), ids)
