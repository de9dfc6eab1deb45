"""A laid-out scene with its looks, as the renderer takes it; and its models as a library."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim import __version__
from realsim.formats.bop.models import INFO_FILE, info_of, model_files
from realsim.geometry import se3
from realsim.models import library_files as files
from realsim.models.convex import collision_obj
from realsim.models.library_prepare import convex_note
from realsim.models.library_records import KnownSolid, ModelProperties, ScaleNote
from realsim.records import ObjectModel, ObjectPose, Scene, SupportPlane
from realsim.rendering.appearance import Material
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.store import atomic
from realsim_sim_bridge.synthetic.scene import SyntheticScene
from realsim_sim_bridge.table_scenes.config import TableSceneConfig
from realsim_sim_bridge.table_scenes.layout import Layout, layout_to_json
from realsim_sim_bridge.table_scenes.looks import (
    OwnLooks,
    draw_environment,
    object_look,
    part_looks,
)
from realsim_sim_bridge.table_scenes.pool import ObjectPool
from realsim_sim_bridge.table_scenes.pool_objects import read_object
from realsim_sim_bridge.table_scenes.sample import generator, scene_table, sized
from realsim_sim_bridge.table_scenes.tables import TableModel, TablePart, floor, walls

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class BuiltScene:
    """A scene that can be rendered."""

    synthetic: SyntheticScene
    solids: dict[int, KnownSolid]
    """Convex parts and matter by object id."""
    table: TableModel

    def hulls(self) -> list[Array]:
        """Return the corners (V, 3) of every convex part where it lies, in the table's frame."""
        return [
            se3.transform(o.T_world_obj, part)
            for o in self.synthetic.scene.objects
            for part in self.solids[o.obj_id].parts.parts
        ]


def scene_name(number: int) -> str:
    """Return the name of a scene and of its folder."""
    return f"scene_{number:06d}"


def build_scene(
    layout: Layout,
    pool: ObjectPool,
    config: TableSceneConfig,
    *,
    own: OwnLooks | None = None,
    farthest_m: float = 2.0,
    cache: Path | None = None,
) -> BuiltScene:
    """Return a scene with its meshes read again and its looks drawn; its world is the table.

    Args:
        layout: what lies where.
        pool: where the objects come from.
        config: of the sampler.
        own: the user's skies and textures.
        farthest_m: distance of the farthest camera: walls stand behind it [m].
        cache: folder for convex parts.

    Raises:
        InputError: a mesh that was there when the scene was laid out cannot be read.
    """
    own = own or OwnLooks()
    table, rng = scene_table(layout.seed, layout.number, config)
    models: dict[int, ObjectModel] = {}
    solids: dict[int, KnownSolid] = {}
    materials: dict[int, Material] = {}
    poses: list[ObjectPose] = []
    looks = generator(layout.seed, layout.number, "looks")
    environment = draw_environment(looks, own)
    room: tuple[TablePart, ...] = (floor(table.height_m),)
    # A wall in the sun's way would leave the picture dark: its exposure is that of open air.
    if rng.uniform() < config.walls and max(environment.sun) == 0:
        room = (*room, walls(table.height_m, farthest_m, rng))
    around = part_looks(table, room, looks, own)
    names = _unique([o.name for o in layout.objects])
    for instance, laid in enumerate(layout.objects):
        found = read_object(pool.sources[laid.source], laid.key, config.pool, cache)
        keep = config.pool.keep_size
        density = found.density if keep and found.density else config.density
        obj_id = instance + 1
        model, solid = sized(found, laid.scale, obj_id, density, centred=not keep)
        models[obj_id] = _named(model, names[instance])
        solids[obj_id] = solid
        material = object_look(looks, own)
        if not found.has_look:
            materials[instance] = material
        poses.append(
            ObjectPose(
                obj_id=obj_id, instance=instance, T_world_obj=laid.T_table_obj, verdict="accepted"
            )
        )
    scene = Scene(
        name=scene_name(layout.number),
        objects=tuple(poses),
        plane=SupportPlane(T_world_table=np.eye(4)),
    )
    placed = tuple(
        PlacedMesh(BACKGROUND, part.mesh, np.eye(4), look)
        for part, look in zip((*table.parts, *room), around, strict=True)
    )
    synthetic = SyntheticScene(
        name=scene.name, scene=scene, models=models, environment=environment,
        materials=materials, surroundings=placed, provenance=_provenance(layout, pool),
    )  # fmt: skip
    return BuiltScene(synthetic=synthetic, solids=solids, table=table)


def _unique(names: list[str]) -> list[str]:
    """Return the names with a number after those that come again."""
    seen: dict[str, int] = {}
    out: list[str] = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        out.append(name if seen[name] == 1 else f"{name}-no{seen[name]}")
    return out


def _named(model: ObjectModel, name: str) -> ObjectModel:
    from dataclasses import replace

    return replace(model, name=name)


def _provenance(layout: Layout, pool: ObjectPool) -> dict[str, Any]:
    return {
        "made_by": "realsim generate",
        "version": __version__,
        "poses": "simulated: dropped in PyBullet until rest",
        "pool": [s.label for s in pool.sources],
        "layout": layout_to_json(layout),
    }


def write_models(folder: Path, built: BuiltScene) -> None:
    """Write the scene's models as a library, with convex parts and matter as they were dropped.

    The Robot School then tries grasps on the very parts that lie in the scene.
    """
    info: dict[str, Any] = {}
    laid = built.synthetic.provenance["layout"]["objects"]
    for obj_id, model in built.synthetic.models.items():
        solid = built.solids[obj_id]
        new = {files.collision_file(obj_id): collision_obj(solid.parts), **model_files(model)}
        properties = ModelProperties(
            name=model.name,
            verdict="accepted",
            obj_id=obj_id,
            matter=solid.matter,
            convex=convex_note(solid.parts),
            scale=ScaleNote(
                scale=float(laid[obj_id - 1]["scale"]),
                sigma_percent=0.0,
                verdict="accepted",
                how="drawn at random by realsim generate",
            ),
            notes=("symmetries were not looked for",) if len(model.symmetries) == 1 else (),
            files={name: files.sha256(data) for name, data in new.items()},
            versions={"realsim": __version__},
        )
        new[files.properties_file(obj_id)] = files.properties_bytes(properties)
        for name, data in new.items():
            atomic.write_bytes(folder / name, data, flush=False)
        info[str(obj_id)] = info_of(model)
    atomic.write_json(folder / INFO_FILE, info)
