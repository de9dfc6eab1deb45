"""Files of a session that claim what cannot be: an error names file and value."""

import io
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import refusals
from bop_scenes import edit
from realsim.store import SessionStore, load_grasps, load_scene, save_grasps
from reviewed_boxes import grasp_set
from typed_commands import refused

SCENE = "registration/scene.json"


def claimed(shape: tuple[int, ...]) -> bytes:
    """Return a .npy of a few bytes whose header claims an array of doubles."""
    buffer = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(buffer, header)
    return buffer.getvalue() + bytes(128)


def with_claim(path: Path, name: str, shape: tuple[int, ...]) -> None:
    """Give one array of an npz another header."""
    with zipfile.ZipFile(path) as file:
        parts = {n: file.read(n) for n in file.namelist()}
    parts[f"{name}.npy"] = claimed(shape)
    with zipfile.ZipFile(path, "w") as file:
        for n, data in parts.items():
            file.writestr(n, data)


def first_object(**values: Any) -> Callable[[Any], None]:
    return lambda scene: scene["objects"][0].update(values)


def moved(metres: float) -> Callable[[Any], None]:
    def change(scene: Any) -> None:
        scene["objects"][0]["T_world_obj"][0][3] = metres

    return change


SCENES = {
    "an id that is a path": (first_object(obj_id="../../etc"), "expected `int`"),
    "an id beyond all": (first_object(obj_id=10**12), "obj_id is 1000000000000"),
    "a negative id": (first_object(obj_id=-1), "obj_id is -1"),
    "a negative instance": (first_object(instance=-2), "the instance of object .* is -2"),
    "an object far away": (moved(1e9), r"1e\+09 m from the origin"),
    "a pose by hand": (moved(0.3), "changed after it was written.*`realsim review`"),
}
FAR = [[1, 0, 0, 1e9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
HEADERS = {
    "a wide camera": (lambda h: h["camera"].update(width=10**9), "1000000000x"),
    "no depth unit": (lambda h: h.update(depth_unit_m=0), "the depth unit is 0"),
    "a far camera": (lambda h: h["T_world_cam"].update({"0": FAR}), r"1e\+09 m from the origin"),
}


@pytest.fixture()
def session(registered_session: Path, tmp_path: Path) -> Path:
    shutil.copytree(registered_session, tmp_path / "session")
    return tmp_path / "session"


def told_by_all(session: Path, out: Path) -> list[str]:
    """Return what commands that read all of a session say; none may end otherwise."""
    typed = (
        ("stats", session), ("annotate", session), ("school", session, "--grasps", 1),
        ("review", session, "--static", out / "page.html"),
        ("export", session, "--to", "bop", "--out", out / "bop"),
    )  # fmt: skip
    return [refused(*words, "--quiet") for words in typed]


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_is_bounded(name: str, session: Path, tmp_path: Path) -> None:
    change, words = SCENES[name]
    edit(session / SCENE, change)
    assert "scene.json" in refusals.refused(words, load_scene, SessionStore.open(session))
    assert all("scene.json" in told for told in told_by_all(session, tmp_path))


@pytest.mark.parametrize("name", HEADERS)
def test_a_header_is_bounded(name: str, session: Path) -> None:
    change, words = HEADERS[name]
    edit(session / "session.json", change)
    said = refused("stats", session)
    assert "session" in said and re.search(words, said)


@pytest.mark.parametrize("array", ["Ts_obj_grasp", "failures", "scores"])
def test_what_a_grasp_set_claims_is_there(array: str, session: Path) -> None:
    file = save_grasps(SessionStore.open(session), grasp_set(1, 0, 3))
    with_claim(file, array, (10**11, 4, 4))
    assert str(file) in refusals.refused("100000000000x4x4", load_grasps, session)
    refused("stats", session)
