"""Files of a session that claim what cannot be: an error names file and value.

A command that was ended in the middle, run again, ends like one left alone.

Nothing in the product runs what a file or a user says: no pickle, eval, shell or unsafe YAML.
"""

import ast
import importlib
import io
import json
import re
import shutil
import signal
import subprocess
import sys
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
    refusals.refused("nix' is not a folder", load_grasps, session / "nix")
    refused("stats", session)


sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
kills: Any = importlib.import_module("reliability_kills")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kills")
    kills.make_inputs(root / "work")
    return root


@pytest.fixture(scope="module", params=["annotate", "export", "stats"])
def command(request: pytest.FixtureRequest, root: Path) -> Any:
    return kills.Command(root, kills.LONG[request.param])


@pytest.mark.parametrize(
    "how", [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_a_killed_command_ends_like_one_left_alone(command: Any, how: int) -> None:
    caught, much = False, command.seconds
    while not caught:  # the machine may be faster now than when the time was taken
        much /= 2
        caught, differs = command.ended(how, much)
        assert differs == []


@pytest.mark.parametrize("room", [2_000, pytest.param(9_000, marks=pytest.mark.slow)])
def test_a_full_disk_is_told_and_the_same_command_goes_on(command: Any, room: int) -> None:
    caught, differs = command.ended(kills.FULL, room)
    assert caught and differs == []


ROOT = Path(__file__).parents[2]
PRODUCT = ("realsim", "calibration", "capture_plans", "sim_bridge")


def broken_rules(*paths: Path | str) -> set[tuple[str, str]]:
    """Return (rule, file) of what pyproject.toml's S rules find, told off in a comment or not."""
    how = ["--config", "pyproject.toml", "--ignore-noqa", "--no-cache", "--output-format", "json"]
    command = [sys.executable, "-m", "ruff", "check", *how, *paths]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    found = json.loads(done.stdout)
    return {(f["code"], f["filename"]) for f in found if str(f["code"]).startswith("S")}


def allowing_pickles(path: Path) -> bool:
    """Return whether a file lets numpy unpickle, or leaves it to a variable."""
    if "allow_pickle" not in (text := path.read_text()):
        return False
    words = [k for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Call)
             for k in n.keywords if k.arg == "allow_pickle"]  # fmt: skip
    return any(not isinstance(k.value, ast.Constant) or k.value.value for k in words)


def test_the_product_runs_nothing_that_a_file_brings() -> None:
    assert not broken_rules(*PRODUCT)
    files = [p for room in PRODUCT for p in (ROOT / room).rglob("*.py")]
    assert len(files) > 500 and not [p for p in files if allowing_pickles(p)]


@pytest.mark.parametrize(
    "line",
    ["import pickle; pickle.loads(b'')", "eval(input())", "exec('1')",
     "import os; os.system(input())", "import subprocess as s; s.run(input(), shell=True)",
     "import yaml; yaml.load('', yaml.Loader)"],
)  # fmt: skip
def test_each_rule_is_alive(line: str, tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text(line + "  # noqa\n")
    assert broken_rules(tmp_path)


def test_a_pickled_array_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "a.py"
    for value, expected in (("True", True), ("False", False), ("given", True)):
        path.write_text(f"np.load(path, allow_pickle={value})")
        assert allowing_pickles(path) == expected
