"""The table under the object, and which object is meant."""

import re
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.records import Mesh, SupportPlane
from realsim.registration.evidence import DepthFrame, EvidenceConfig, measure_noise
from realsim.scanning.scale.config import TableConfig
from realsim.scanning.scale.table import Footprint, find_object, find_table
from refusals import refused
from scanned_objects import LAB, Scanned, block, in_world, joined, real_mesh, scanned_mesh, shifted

CONFIG = TableConfig()
SMALL = replace(LAB, views=6, width=320, height=180, focal_px=162.0)


def placed(mesh: Mesh, x: float, y: float = 0.0) -> Mesh:
    """Return the mesh moved on the table, its lowest point at z = 0."""
    low = mesh.vertices[:, 2].min()
    return shifted(mesh, x, y, -float(low))


@lru_cache(maxsize=1)
def two_things() -> Scanned:
    """Return a block of 60 mm and a can of 105 mm, 130 mm apart along the mesh's x."""
    can = placed(real_mesh("cylinder_can"), 0.07)
    return scanned_mesh(joined(placed(block(), -0.06), can), SMALL)


@lru_cache(maxsize=1)
def one_thing() -> Scanned:
    return scanned_mesh(block(), SMALL)


def table_of(known: Scanned, frames: tuple[DepthFrame, ...] | None = None) -> SupportPlane:
    return find_table(known.views.intrinsics, frames or known.frames, CONFIG, 0)


def object_of(
    known: Scanned,
    frames: tuple[DepthFrame, ...] | None = None,
    at: tuple[float, float] | None = None,
) -> Footprint:
    frames = frames or known.frames
    noise = measure_noise(frames, EvidenceConfig())
    plane = table_of(known, frames)
    return find_object(known.views.intrinsics, frames, plane, noise, CONFIG, at)


def test_the_plane_is_found_whatever_the_world_is():
    rng = np.random.default_rng(1)
    T = se3.from_rt(se3.random_rotation(rng), rng.uniform(-2, 2, 3))
    known = one_thing()
    plane = table_of(known, in_world(known.frames, T))
    normal, at = plane.T_world_table[:3, 2], plane.T_world_table[:3, 3]
    assert np.degrees(np.arccos(np.clip(normal @ T[:3, 2], -1, 1))) < 0.3
    assert abs(T[:3, 2] @ (at - T[:3, 3])) < 0.001
    np.testing.assert_allclose(
        plane.T_world_table[:3, :3].T @ plane.T_world_table[:3, :3], np.eye(3), atol=1e-12
    )
    assert np.linalg.det(plane.T_world_table[:3, :3]) > 0


def places(known: Scanned) -> Array:
    """Return x, y (2, 2) in world of block and can."""
    return se3.transform(known.T_world_obj, np.array([[-0.06, 0, 0], [0.07, 0, 0]]))[:, :2]


def test_several_objects_are_named_with_their_places_and_heights():
    known = two_things()
    said = refused(r"2 objects stand on the table.*--at x,y.*alone", object_of, known)
    named = re.findall(r"x=(-?[\d.]+), y=(-?[\d.]+)[^;]*?(\d+) mm tall", said)
    found = np.array(named, dtype=float)
    for where, tall in zip(places(known), (60, 105), strict=True):
        nearest = found[np.argmin(np.linalg.norm(found[:, :2] - where, axis=1))]
        assert np.linalg.norm(nearest[:2] - where) < 0.015
        assert nearest[2] == pytest.approx(tall, abs=8)


@pytest.mark.parametrize(("which", "tall"), [(1, 0.105)])
def test_at_picks_one_of_them_and_nothing_of_the_other(which: int, tall: float):
    known = two_things()
    here, there = places(known)[which], places(known)[1 - which]
    found = object_of(known, at=(float(here[0] + 0.01), float(here[1] - 0.01)))
    plane = table_of(known)
    middle = se3.transform(plane.T_world_table, found.box.mean(0))[0]
    assert np.linalg.norm(middle[:2] - here) < 0.012
    assert found.box[1, 2] == pytest.approx(tall, abs=0.010)
    cell = np.floor(
        (se3.transform(se3.invert(plane.T_world_table), np.array([*there, 0.0]))[0, :2]
         - found.origin) / found.cell_m
    ).astype(int)  # fmt: skip
    if np.all((cell >= 0) & (cell < found.near.shape)):
        assert not found.near[tuple(cell)] and not found.around[tuple(cell)]


def test_without_a_plane_no_table_is_claimed():
    known = one_thing()
    rng = np.random.default_rng(0)
    frames = tuple(
        replace(f, depth_m=rng.uniform(0.1, 1.0, f.depth_m.shape).astype(np.float32))
        for f in known.frames
    )
    with pytest.raises(DegenerateError, match=r"largest plane carries \d+ %.*flat table"):
        table_of(known, frames)
