"""What the annotation of a view depends on, checked, with a digest that says when it changed."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from realsim import images, records
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.geometry.mesh import box_mesh
from realsim.records.grasps import LABEL_MEASURES
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.store import SessionStore
from realsim.store.session_store import depth_path, rgb_path
from realsim.untrusted.own_json import to_json
from realsim_sim_bridge.annotation.config import AnnotationConfig

FORMAT_VERSION = 3
"""Part of every digest: a new version annotates anew."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameInputs:
    """What all views of a session have in common; it can be sent to another process."""

    config: AnnotationConfig
    intrinsics: records.CameraIntrinsics
    depth_unit_m: float
    """Metres per count of the session's depth images."""
    objects: tuple[records.ObjectPose, ...]
    """The objects that are annotated, in the order of the masks."""
    models: Mapping[int, records.ObjectModel]
    """obj_id -> model of these objects."""
    grasp_sets: tuple[records.GraspSet, ...]
    surroundings: tuple[PlacedMesh, ...]
    """What hides things without carrying a label: the table."""
    digest: str

    def placed(self) -> list[PlacedMesh]:
        """Return the meshes that are seen or hide things: the objects and what is around them."""
        objects = [
            PlacedMesh(o.instance, self.models[o.obj_id].mesh, o.T_world_obj) for o in self.objects
        ]
        return [*objects, *self.surroundings]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class FrameView:
    """One view to annotate."""

    index: int
    T_world_cam: Array
    """(4, 4) camera in world [m]."""
    digest: str
    """Digest of everything its annotation depends on."""


def gathered(
    store: SessionStore,
    scene: records.Scene,
    models: Mapping[int, records.ObjectModel],
    grasp_sets: Sequence[records.GraspSet],
    config: AnnotationConfig,
    surroundings: Sequence[PlacedMesh] | None = None,
) -> FrameInputs:
    """Return the checked inputs of all views; rejected objects and their grasps are left out.

    What hides things are `surroundings`; None = a table under the scene's plane, if it has one.

    Raises:
        InputError: a model is missing, or grasps are of an instance that is not in the scene.
    """
    chosen = sorted((o for o in scene.objects if o.verdict != "rejected"), key=lambda o: o.instance)
    missing = sorted({o.obj_id for o in chosen} - set(models))
    if missing:
        raise InputError(
            f"scene '{scene.name}' holds objects {missing} without a model; the models given are: "
            f"{records.names_of(list(models.values()))}. Put the missing ones into models/."
        )
    for g in grasp_sets:
        if scene.object(g.instance).obj_id != g.obj_id:
            raise InputError(
                f"the grasps of instance {g.instance} are of object {g.obj_id}, but in the scene "
                f"this instance is object {scene.object(g.instance).obj_id}. Run the school again."
            )
    if surroundings is None:
        surroundings = _table(scene, config)
    instances = {o.instance for o in chosen}
    kept = sorted((g for g in grasp_sets if g.instance in instances), key=lambda g: g.instance)
    return FrameInputs(
        config=config,
        intrinsics=store.session.intrinsics,
        depth_unit_m=store.session.depth_unit_m,
        objects=tuple(chosen),
        models={o.obj_id: models[o.obj_id] for o in chosen},
        grasp_sets=tuple(kept),
        surroundings=tuple(surroundings),
        digest=_scene_digest(store, chosen, models, kept, config, surroundings),
    )


def _table(scene: records.Scene, config: AnnotationConfig) -> list[PlacedMesh]:
    """Return the table under the plane of a registered scene, if it has one."""
    if scene.plane is None:
        return []
    return [PlacedMesh(BACKGROUND, table_slab(config), scene.plane.T_world_table)]


def table_slab(config: AnnotationConfig) -> records.Mesh:
    """Return the table as a closed box under the plane z = 0 of frame `table` [m]."""
    half, top = config.table_m / 2, -config.plane_clearance_m
    return box_mesh((-half, -half, top - config.table_thickness_m), (half, half, top))


def _scene_digest(
    store: SessionStore,
    chosen: Sequence[records.ObjectPose],
    models: Mapping[int, records.ObjectModel],
    grasp_sets: Sequence[records.GraspSet],
    config: AnnotationConfig,
    surroundings: Sequence[PlacedMesh],
) -> str:
    """Return the digest of what all views have in common."""
    i = store.session.intrinsics
    digest = hashlib.sha256(json.dumps([FORMAT_VERSION, asdict(config)]).encode())
    numbers = [i.width, i.height, i.fx, i.fy, i.cx, i.cy, store.session.depth_unit_m]
    digest.update(np.array([*numbers, *i.distortion]).tobytes())
    for o in chosen:
        digest.update(json.dumps(to_json(o), sort_keys=True).encode())
    for obj_id in sorted({o.obj_id for o in chosen}):
        model = models[obj_id]
        digest.update(f"{obj_id} {model.name} ".encode())
        digest.update(model.mesh.vertices.tobytes() + model.mesh.faces.tobytes())
    for g in grasp_sets:
        names = [name for name in LABEL_MEASURES if name in g.measures]
        digest.update(f"{g.instance} {g.obj_id} {len(g)} {names} ".encode())
        columns = (g.Ts_obj_grasp, g.widths_m, g.scores, g.base_scores, g.reachable)
        for array in (*columns, *(g.measures[name] for name in names)):
            digest.update(np.ascontiguousarray(array).tobytes())
    for p in surroundings:
        for array in (p.T_world_obj, p.mesh.vertices, p.mesh.faces):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def frame_view(store: SessionStore, inputs: FrameInputs, view: records.View) -> FrameView:
    """Return a view with the digest of everything its annotation depends on.

    The depth enters as its file's bytes, which are a tenth of the image and need no decoding.

    Raises:
        InputError: its depth image is missing, or an image is not of the camera's size.
    """
    paths = [rgb_path(view.index)]
    paths += [depth_path(view.index)] if store.has_depth(view.index) else []
    for path in paths:
        _check_size(store, inputs.intrinsics, path)
    digest = hashlib.sha256(inputs.digest.encode())
    digest.update(np.asarray(view.T_world_cam).tobytes())
    if len(paths) > 1:
        digest.update(store.path(paths[1]).read_bytes())
    return FrameView(
        index=view.index, T_world_cam=np.asarray(view.T_world_cam), digest=digest.hexdigest()
    )


def _check_size(store: SessionStore, intrinsics: records.CameraIntrinsics, path: str) -> None:
    """Raise if an image is not of the camera's size."""
    width, height = images.image_size(store.path(path))
    if (width, height) != (intrinsics.width, intrinsics.height):
        raise InputError(
            f"{store.path(path)} is {width}x{height} pixels, the session's camera "
            f"{intrinsics.width}x{intrinsics.height}: labels would not lie on the picture. "
            "Calibrate at the size of the images, or bring the images back to the camera's size."
        )
