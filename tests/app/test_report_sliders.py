"""Sliders in the report: the outlines before and after, where there is a before."""

from pathlib import Path

import numpy as np
import pytest

from begun_sessions import add_drawn, begun
from plain_meshes import box
from realsim import CameraIntrinsics, ObjectModel, ObjectPose, Scene
from realsim.app.report.sliders import registration_pairs
from realsim.app.stages import save_starts
from realsim.formats.bop.models import save_models
from realsim.geometry import se3
from realsim.rendering.labels import LabelRenderer, PlacedMesh
from realsim.store import SessionStore, save_scene

INTRINSICS = CameraIntrinsics(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
SHIFT_M = 0.02


BLOCK = box((0.06, 0.05, 0.04))


def pose(x: float) -> ObjectPose:
    return ObjectPose(obj_id=1, instance=2, T_world_obj=se3.from_translation([x, 0.0, 0.02]))


@pytest.fixture
def store(tmp_path: Path) -> SessionStore:
    store = begun(tmp_path / "one", INTRINSICS)
    renderer = LabelRenderer([PlacedMesh(2, BLOCK, pose(0.0).T_world_obj)])
    eyes = [[0.3 * np.cos(a), 0.3 * np.sin(a), 0.25] for a in (0.0, 1.5, 3.0, 4.5)]
    add_drawn(store, renderer, [se3.look_at(eye, [0.0, 0.0, 0.02]) for eye in eyes])
    save_scene(store, Scene(name="one", objects=(pose(0.0),), plane=None))
    save_models(store.folder / "models", {1: ObjectModel(obj_id=1, name="b", mesh=BLOCK)})
    return store


def coloured(picture: object) -> np.ndarray:
    assert isinstance(picture, np.ndarray)
    return np.ptp(picture.astype(int), axis=-1) > 40


def test_the_outline_moves_from_the_start_onto_the_object(store: SessionStore) -> None:
    save_starts(store, [pose(SHIFT_M)], "a rough guess")
    pairs, before = registration_pairs(store)
    assert "1 of 1 objects at the rough pose" in before and "cameras" not in before
    assert [p.caption for p in pairs] == ["view 0", "view 2", "view 3"]
    for p in pairs:
        on_object = store.rgb(int(p.caption.split()[1]))[..., 0] == 200
        # After, the outline lies within the object; before, it does not.
        assert np.mean(on_object[coloured(p.pictures["registered"])]) > 0.99
        assert np.mean(on_object[coloured(p.pictures["before"])]) < 0.9


def test_without_a_before_there_are_no_sliders(store: SessionStore) -> None:
    assert registration_pairs(store) == ([], "")
    clicked = {"starts": [{"instance": 2, "click": [3, 80, 60]}]}
    store.write_json("registration/starts.json", clicked)
    assert registration_pairs(store) == ([], "")
