"""Damaged files of every format end in realsim's own error or in a correct read."""

import importlib
import sys
from pathlib import Path
from typing import Any

import pytest

from realsim.errors import InputError
from realsim.formats.bags import open_bag
from realsim.formats.grasps.hdf5 import read_grasps_hdf5, write_grasps_hdf5
from realsim.geometry import mesh_files
from realsim.geometry.mesh_files import load_mesh
from realsim.models import mesh_loading
from realsim.models.reading import read_scan
from refusals import refused
from tried_grasps import tried_scene
from written_bags import recorded
from written_meshes import as_trimesh, textured_box

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
mutations: Any = importlib.import_module("formats_mutations")

worker: Any = importlib.import_module("formats_mutations_worker")
scenes: Any = importlib.import_module("formats_mutations_scenes")


def test_damaged_files_are_refused_or_read() -> None:
    found = list(mutations.mutations(40, 4_000, 1, list(mutations.SAMPLES)[::5]))
    assert len(found) == 40
    assert [o for o in found if o.kind not in mutations.RIGHT] == []
    assert sum(o.kind == "refused" for o in found) > 10  # the damage is real
    assert sum(o.kind == "read" for o in found) > 3  # and not all is fatal


@pytest.mark.slow
def test_many_damaged_files_are_refused_or_read() -> None:
    done = {(o.name, o.seed) for o in mutations.mutations(40, 50_000, 2)}
    found = list(mutations.mutations(300, 50_000, 2, done=done))
    assert len(found) == 260 and done.isdisjoint((o.name, o.seed) for o in found)
    assert [o for o in found if o.kind not in mutations.RIGHT] == []


# --- the harness sees what it is made to see -----------------------------------------------------


def _make(folder: Path) -> None:
    (folder / "a.bin").write_bytes(bytes(100))


def _offence(kind: str) -> Any:
    def read(folder: Path) -> Any:
        data = (folder / "a.bin").read_bytes() if (folder / "a.bin").is_file() else b""
        if data == bytes(100):
            return []  # the whole sample
        if kind == "nan":
            return [{"x": float("nan")}]
        if kind == "crash":
            import os

            os.abort()
        while True:  # a hang
            pass

    return scenes.Sample(kind, _make, read)


@pytest.mark.parametrize("kind", ["nan", pytest.param("crash", marks=pytest.mark.slow)])
def test_every_class_of_offence_is_seen_and_costs_one_mutation_only(kind: str) -> None:
    sample = _offence(kind)
    jobs = [worker.Job(kind, tuple(range(8)))]
    found = list(worker.outcomes({kind: sample}, jobs, 1))
    assert sorted(o.seed for o in found) == list(range(8))
    assert {o.kind for o in found} <= {kind, "read"}
    assert sum(o.kind == kind for o in found) >= 4


@pytest.mark.slow
def test_a_hang_is_seen() -> None:
    jobs = [worker.Job("hang", (3,))]
    (found,) = worker.outcomes({"hang": _offence("hang")}, jobs, 1)
    assert found.kind == "hang"


# --- Damage that readers of files of others once did not expect: each is refused with its place.


def test_a_heap_in_which_the_library_would_go_round_for_ever_is_refused(tmp_path: Path) -> None:
    path = write_grasps_hdf5(tmp_path / "a.h5", tried_scene(4))
    assert read_grasps_hdf5(path).name == "Tisch 1"
    raw = path.read_bytes()
    at = raw.index(b"GCOL\x01\0\0\0") + 16
    for zeros in (16, 40):
        path.write_bytes(raw[:at] + bytes(zeros) + raw[at + zeros :])
        refused("heap of texts", read_grasps_hdf5, path)


# --- recordings -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new"),
    [("message_count: ", "message_count: x"), ("name: /camera", "name: [/camera] #")],
)
def test_a_damaged_table_of_contents_is_refused(tmp_path: Path, old: str, new: str) -> None:
    path = recorded(tmp_path, "mcap", 3).path
    text = (path / "metadata.yaml").read_text()
    assert old in text
    (path / "metadata.yaml").write_text(text.replace(old, new))
    refused("recording", open_bag, path)


def test_lengths_of_gigabytes_in_recordings_are_refused_or_not_believed(tmp_path: Path) -> None:
    path = recorded(tmp_path, "mcap", 3).path
    file = path if path.is_file() else next(path.glob("*.mcap"))
    raw = file.read_bytes()
    for at in range(8, 120, 20):
        file.write_bytes(raw[:at] + b"\xff\xff\xff\x7f" + raw[at + 4 :])
        try:
            source = open_bag(path)
            assert len(list(source.frames())) <= 3
        except InputError as error:
            assert "recording" in str(error)


# --- textures -------------------------------------------------------------------------------------


def test_a_texture_of_absurd_size_is_left_out_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.glb"
    path.write_bytes(as_trimesh(textured_box()).export(file_type="glb"))
    assert load_mesh(path, "m", []).texture is not None
    monkeypatch.setattr(mesh_files, "MOST_TEXELS", 100)
    monkeypatch.setattr(mesh_loading, "MOST_TEXELS", 100)
    notes: list[str] = []
    assert load_mesh(path, "m", notes).texture is None
    assert any("cannot be decoded" in note for note in notes)
    scan = read_scan(path, "m")
    assert any("32x32 pixels" in note for note in scan.notes)


def test_a_texture_that_is_damaged_inside_a_glb_is_not_made_up(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    path.write_bytes(as_trimesh(textured_box()).export(file_type="glb"))
    data = bytearray(path.read_bytes())
    at = data.index(b"IDAT")
    data[at + 4 : at + 40] = bytes(36)
    path.write_bytes(data)
    refused(r"a\.glb cannot be read", load_mesh, path, "m")
    assert any("cannot be decoded" in note for note in read_scan(path, "m").notes)
