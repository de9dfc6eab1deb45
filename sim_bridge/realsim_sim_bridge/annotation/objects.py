"""What holds for an object in every view: verdict, matter, box, and points on its surface."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from realsim.geometry import mesh_shape
from realsim.records import Mesh, ObjectModel, Scene
from realsim.store import SessionStore
from realsim.store.atomic import npz_bytes
from realsim.store.records_json import object_pose_to_json
from realsim_sim_bridge.annotation.config import AnnotationConfig
from realsim_sim_bridge.annotation.files import OBJECTS_FILE, surface_path
from realsim_sim_bridge.annotation.inputs import FORMAT_VERSION


def write_objects(
    store: SessionStore,
    scene: Scene,
    models: Mapping[int, ObjectModel],
    config: AnnotationConfig,
) -> None:
    """Write annotations/objects.json, and the surface cloud of every model that is annotated."""
    annotated = sorted({o.obj_id for o in scene.objects if o.verdict != "rejected"})
    for obj_id in annotated:
        _write_surface(store, obj_id, models[obj_id].mesh, config.surface_points)
    entries = _object_entries(scene, models)
    store.write_json(OBJECTS_FILE, {"format_version": FORMAT_VERSION, "objects": entries})


def _write_surface(store: SessionStore, obj_id: int, mesh: Mesh, count: int) -> None:
    """Write points (N, 3) [m] and normals (N, 3) in the object's frame, float32.

    The object's number seeds them, so that the same model has the same points in every session.
    """
    points, normals = mesh_shape.sample_surface(mesh, count, np.random.default_rng(obj_id))
    data = npz_bytes(points=points.astype(np.float32), normals=normals.astype(np.float32))
    path = surface_path(obj_id)
    if not store.has(path) or store.path(path).read_bytes() != data:
        store.write_bytes(path, data)


def _object_entries(scene: Scene, models: Mapping[int, ObjectModel]) -> list[dict[str, Any]]:
    """Return one entry per object of the scene, rejected ones included."""
    entries: list[dict[str, Any]] = []
    for placed in scene.objects:
        entry = object_pose_to_json(placed)
        if placed.obj_id in models:
            model = models[placed.obj_id]
            low, high = model.mesh.bounds
            matter = mesh_shape.mass_properties(model.mesh, model.density)
            is_annotated = placed.verdict != "rejected"
            entry["name"] = model.name
            entry["annotated"] = is_annotated
            entry["box_obj_m"] = {"low": low.tolist(), "high": high.tolist()}
            entry["surface"] = surface_path(placed.obj_id) if is_annotated else None
            entry["physical"] = {
                "extent_m": model.mesh.extent.tolist(),
                "diameter_m": mesh_shape.diameter(model.mesh),
                "centroid_obj_m": matter.center_of_mass.tolist(),
                "volume_m3": matter.volume_m3,
                "density_kg_m3": model.density,
                "mass_kg": matter.mass_kg,
                "inertia_kg_m2": matter.inertia.tolist(),
                "convex_hull_volume_fraction": matter.hull_volume_fraction,
                "is_watertight": matter.is_watertight,
            }
        entries.append(entry)
    return entries
