"""A laid-out scene with its looks, as the renderer takes it; and its models as a library."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim import __version__
from realsim.arrays import Array
from realsim.errors import InputError
from realsim.formats.bop.models import INFO_FILE, info_of, model_files
from realsim.geometry import se3
from realsim.models import library_files as files
from realsim.models.convex import collision_obj
from realsim.models.library_prepare import convex_note
from realsim.models.model_records import KnownSolid, ModelProperties, ScaleNote
from realsim.records import ObjectModel, ObjectPose, Scene, SupportPlane
from realsim.rendering.appearance import Environment, Material
from realsim.rendering.rays import BACKGROUND, PlacedMesh
from realsim.store import atomic
from realsim_sim_bridge.synthetic.scene import SyntheticScene
from realsim_sim_bridge.table_scenes import sample
from realsim_sim_bridge.table_scenes.config import TableSceneConfig
from realsim_sim_bridge.table_scenes.pool import ObjectPool, read_object
from realsim_sim_bridge.table_scenes.tables import TableModel, TablePart, floor, walls

# --- How a scene looks: materials and light, made by formulas or of the user's own images --------


FRAME_KINDS = ("oak", "walnut", "birch", "pine", "painted wood", "painted metal", "brushed steel",
               "aluminium", "matte plastic")  # fmt: skip
"""What legs, columns and drawers are made of."""
DETAIL_KINDS = ("brushed steel", "aluminium", "painted metal", "birch", "oak", "painted wood",
                "matte plastic", "rubber")  # fmt: skip
"""What edges, handles and feet are made of."""
WALL_KINDS = ("painted wood", "concrete", "matte plastic", "ceramic tiles", "laminate")
"""What is behind a table."""
GLASS = "glossy plastic"
"""Stands for a plate of coloured glass that is painted on its underside: glossy, one colour."""
HDRI_SUFFIXES = (".hdr", ".exr")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff")
PERIODS_M = (0.2, 0.8)
"""Edge of one tile of the user's own pictures [m]; they do not say how large they are."""
LEAST_WALL_PERIOD_M = 1.0
"""Walls are seen from afar: smaller tiles would show as a grid [m]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class OwnLooks:
    """The user's own skies and textures; an empty list = those of formulas."""

    hdris: tuple[Path, ...] = ()
    textures: tuple[Path, ...] = ()
    """Folders, each with the images of one material, and pictures that are one each."""


def own_looks(hdris: Path | None, textures: Path | None) -> OwnLooks:
    """Return what the user's folders hold.

    Args:
        hdris: folder of panoramas (.hdr, .exr), below it too.
        textures: folder of pictures, each a material of its own, and of folders, each with the
            images of one material.

    Raises:
        InputError: a folder is missing, or holds none.
    """
    skies = _files(hdris, "--hdris", HDRI_SUFFIXES)
    images = _files(textures, "--textures", IMAGE_SUFFIXES)
    materials = {p if p.parent == textures else p.parent for p in images}
    return OwnLooks(hdris=skies, textures=tuple(sorted(materials)))


def _files(folder: Path | None, option: str, suffixes: tuple[str, ...]) -> tuple[Path, ...]:
    if folder is None:
        return ()
    if not folder.is_dir():
        raise InputError(f"{option} '{folder}' is no folder.")
    found = sorted(p for p in folder.rglob("*") if p.suffix.lower() in suffixes and p.is_file())
    if not found:
        raise InputError(
            f"{option} '{folder}' holds no image; files of the kinds {', '.join(suffixes)} are "
            "read, in folders below it, too. Leave the option away for those of formulas."
        )
    return tuple(found)


def draw_environment(rng: np.random.Generator, own: OwnLooks) -> Environment:
    """Return the light of a scene."""
    if own.hdris:
        from realsim.rendering.procedural.hdri import read_environment

        return read_environment(own.hdris[int(rng.integers(len(own.hdris)))])
    from realsim.rendering.procedural.choose import random_environment

    return random_environment(rng)


def object_look(rng: np.random.Generator, own: OwnLooks) -> Material:
    """Return the material of an object."""
    from realsim.rendering.procedural.choose import object_material

    return _own_texture(rng, own) or object_material(rng)


def part_looks(
    table: TableModel, room: tuple[TablePart, ...], rng: np.random.Generator, own: OwnLooks
) -> list[Material]:
    """Return the materials of the table's parts and the room's, in their order.

    Parts of one role share a material, as furniture does; a plate of glass is glossy.
    """
    made: dict[str, Material] = {}
    for part in (*table.parts, *room):
        key = "glass" if part.name == "plate" else part.role
        if key not in made:
            made[key] = _part_look(key, rng, own)
    return [made["glass" if p.name == "plate" else p.role] for p in (*table.parts, *room)]


def _part_look(key: str, rng: np.random.Generator, own: OwnLooks) -> Material:
    from realsim.rendering.procedural.choose import floor_material, random_material, table_material

    def one_of(kinds: tuple[str, ...]) -> Material:
        return random_material(rng, kinds[int(rng.integers(len(kinds)))])

    if key == "glass":
        return replace(one_of((GLASS,)), roughness=0.08, roughness_image=None, name="glass plate")
    if key in ("frame", "detail"):
        return one_of(FRAME_KINDS if key == "frame" else DETAIL_KINDS)
    texture = _own_texture(rng, own)
    if texture is not None:
        return texture
    if key == "wall":
        made = one_of(WALL_KINDS)
        return replace(made, period_m=max(made.period_m, LEAST_WALL_PERIOD_M))
    return floor_material(rng) if key == "floor" else table_material(rng)


def _own_texture(rng: np.random.Generator, own: OwnLooks) -> Material | None:
    if not own.textures:
        return None
    from realsim.rendering.procedural.texture_folder import material_from_images

    path = own.textures[int(rng.integers(len(own.textures)))]
    return material_from_images(path, float(rng.uniform(*PERIODS_M)))


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
    layout: sample.Layout,
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
    table, rng = sample.scene_table(layout.seed, layout.number, config)
    models: dict[int, ObjectModel] = {}
    solids: dict[int, KnownSolid] = {}
    materials: dict[int, Material] = {}
    poses: list[ObjectPose] = []
    looks = sample.generator(layout.seed, layout.number, "looks")
    environment = draw_environment(looks, own)
    room: tuple[TablePart, ...] = (floor(table.height_m),)
    # A wall in the sun's way would leave the picture dark: its exposure is that of open air.
    if rng.uniform() < config.walls and max(environment.sun) == 0:
        room = (*room, walls(table.height_m, farthest_m, rng))
    around = part_looks(table, room, looks, own)
    names = list(_unique([o.name for o in layout.objects]))
    for instance, laid in enumerate(layout.objects):
        found = read_object(pool.sources[laid.source], laid.key, config.pool, cache)
        keep = config.pool.keep_size
        density = found.density if keep and found.density else config.density
        obj_id = instance + 1
        model, solid = sample.sized(found, laid.scale, obj_id, density, centred=not keep)
        models[obj_id] = replace(model, name=names[instance])
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


def _unique(names: list[str]) -> Iterator[str]:
    """Yield the names with a number after those that come again; no file's own name is taken."""
    seen: set[str] = set()
    for name in names:
        numbered = (f"{name}-no{k}" for k in itertools.count(2))
        free = name if name not in seen else next(n for n in numbered if n not in {*seen, *names})
        seen.add(free)
        yield free


def _provenance(layout: sample.Layout, pool: ObjectPool) -> dict[str, Any]:
    return {
        "made_by": "realsim generate",
        "version": __version__,
        "poses": "simulated: dropped in PyBullet until rest",
        "pool": [s.label for s in pool.sources],
        "layout": sample.layout_to_json(layout),
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
        open_edges = int(laid[obj_id - 1]["open_edges"])
        properties = ModelProperties(
            name=model.name,
            verdict="doubtful" if open_edges else "accepted",
            reasons=(f"open: {open_edges} boundary edges",) if open_edges else (),
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
