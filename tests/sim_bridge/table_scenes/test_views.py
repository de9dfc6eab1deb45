"""Cameras of generated scenes, how these look, and the models that the school takes."""

from dataclasses import fields
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from realsim.errors import InputError
from realsim.geometry.mesh import mass_properties
from realsim.models.library_session import known_solids
from realsim.rendering.appearance import Material
from realsim_sim_bridge.table_scenes.cameras import ViewConfig, intrinsics_of, views
from realsim_sim_bridge.table_scenes.config import TableSceneConfig
from realsim_sim_bridge.table_scenes.pool import open_pool
from realsim_sim_bridge.table_scenes.sample import Layout, sample_layout
from realsim_sim_bridge.table_scenes.scene import (
    BuiltScene,
    OwnLooks,
    build_scene,
    own_looks,
    write_models,
)
from realsim_sim_bridge.table_scenes.tables import corners
from refusals import refused

CUBE = [corners((-0.05, -0.05, 0.0), (0.05, 0.05, 0.1))]
SCENE = TableSceneConfig(objects=(2, 2))


@cache
def _layout() -> Layout:
    return sample_layout(1, 0, open_pool(["pybullet"]), SCENE)


@cache
def _built(own: OwnLooks = OwnLooks()) -> BuiltScene:  # noqa: B008 - frozen, and no argument of a user
    return build_scene(_layout(), open_pool(["pybullet"]), SCENE, own=own)


# --- cameras ----------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [(1.0, 2.0), (0.25, 0.5)])
def test_cameras_are_as_far_away_as_asked_above_the_table_and_look_at_it(
    radius: tuple[float, float],
) -> None:
    config = ViewConfig(count=64, radius_m=radius)
    Ts = views(CUBE, config, np.random.default_rng(0))
    eyes, forward = Ts[:, :3, 3], Ts[:, :3, 2]
    assert np.all(eyes[:, 2] > config.clearance_m)
    middle = np.array([0, 0, 0.0 if radius[0] >= config.near_m else 0.05])
    away = np.linalg.norm(eyes - middle, axis=1)
    slack = 1e-9 if radius[0] >= config.near_m else 0.05 * np.sqrt(2)
    assert away.min() >= radius[0] - slack
    assert away.max() <= radius[1] + slack
    to_middle = middle - eyes
    cosine = np.einsum("ij,ij->i", forward, to_middle) / np.linalg.norm(to_middle, axis=1)
    assert np.degrees(np.arccos(cosine.min())) < 25


def test_no_camera_stands_in_an_object_or_a_rim() -> None:
    tall = [corners((0.1, -0.3, 0.0), (0.35, 0.3, 0.6))]
    config = ViewConfig(count=64, radius_m=(0.3, 0.5), elevation_deg=(15, 60))
    for solids, rims in (([*CUBE, *tall], []), (CUBE, tall)):
        eyes = views(solids, config, np.random.default_rng(1), rims)[:, :3, 3]
        low, high = tall[0].min(axis=0), tall[0].max(axis=0)
        gap = np.maximum(np.maximum(low - eyes, eyes - high).max(axis=1), 0)
        assert gap.min() > config.clearance_m


def test_cameras_that_can_only_stand_in_something_are_refused() -> None:
    block = [corners((-1, -1, 0), (1, 1, 2.0))]
    with pytest.raises(InputError, match=r"stand in the objects.*larger --radius"):
        views(block, ViewConfig(count=4, radius_m=(0.3, 0.4), near_m=0.0), np.random.default_rng(0))


def test_a_radius_that_cannot_be_is_refused() -> None:
    for radius in ((0.01, 0.05), (2.0, 1.0), (1.0, 9.0), (-1.0, 1.0)):
        refused("least <= most", ViewConfig, radius_m=radius)


@pytest.mark.parametrize(("profile", "fov_deg"), [("d435", 69.4), ("d405", 89.3)])
def test_fields_of_view_are_the_cameras(profile: str, fov_deg: float) -> None:
    for size in ((1920, 1080), (640, 360)):
        camera = intrinsics_of(profile, size)
        fov = 2 * np.degrees(np.arctan(camera.width / 2 / camera.fx))
        assert fov == pytest.approx(fov_deg, abs=1.0)
        assert (camera.cx, camera.cy) == ((size[0] - 1) / 2, (size[1] - 1) / 2)


# --- looks ------------------------------------------------------------------------------------


def _bytes(material: Material) -> list[bytes]:
    values = (getattr(material, f.name) for f in fields(material))
    return [v.tobytes() if isinstance(v, np.ndarray) else repr(v).encode() for v in values]


def test_the_same_seed_gives_the_same_looks_to_the_byte() -> None:
    a = _built().synthetic
    b = build_scene(_layout(), open_pool(["pybullet"]), SCENE).synthetic
    assert a.digests() == b.digests()
    assert [_bytes(m) for m in a.materials.values()] == [_bytes(m) for m in b.materials.values()]
    assert set(a.materials) == {0, 1}


def test_the_users_own_pictures_cover_table_floor_and_objects(tmp_path: Path) -> None:
    for k, color in enumerate(((0, 0, 255), (0, 255, 0))):
        image = np.full((16, 16, 3), color, np.uint8)
        cv2.imwrite(str(tmp_path / f"paint{k}.png"), image)
    built = _built(own_looks(None, tmp_path)).synthetic
    looks = {p.material.name for p in built.surroundings if p.material is not None}
    assert looks & {"paint0", "paint1"}
    assert {m.name for m in built.materials.values()} <= {"paint0", "paint1"}


def test_a_folder_without_pictures_is_refused(tmp_path: Path) -> None:
    refused(r"--textures .* holds no image", own_looks, None, tmp_path)
    refused(r"--hdris .* is no folder", own_looks, tmp_path / "none", None)


# --- models -----------------------------------------------------------------------------------


def test_the_school_knows_the_parts_and_the_matter_that_were_dropped(tmp_path: Path) -> None:
    built = _built()
    write_models(tmp_path, built)
    solids, unknown = known_solids(tmp_path, [1, 2])
    assert not unknown
    for obj_id, solid in built.solids.items():
        kept = solids[obj_id]
        assert all(
            np.array_equal(np.unique(a, axis=0), np.unique(b, axis=0))
            for a, b in zip(kept.parts.parts, solid.parts.parts, strict=True)
        )
        assert kept.matter.mass_kg == solid.matter.mass_kg
        mesh = built.synthetic.models[obj_id].mesh
        assert kept.matter.mass_kg == pytest.approx(mass_properties(mesh, 1000.0).mass_kg)
