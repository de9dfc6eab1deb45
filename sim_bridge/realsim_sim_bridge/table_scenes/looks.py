"""How a scene looks: materials and light, made by formulas or of the user's own images."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from realsim.errors import InputError
from realsim.rendering.appearance import Environment, Material
from realsim_sim_bridge.table_scenes.tables import TableModel, TablePart

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
    from realsim.rendering.procedural.choose import (
        floor_material,
        random_material,
        table_material,
    )

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
