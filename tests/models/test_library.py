"""The model library: what goes in comes out, and nothing that happens on the way loses a model.

The sheet of a model shows what it should: the same at every size, open rims, parts, axes.
"""

import json
import re
import shutil
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest

from file_trees import bytes_of
from killed_children import in_children, killed_at
from plain_meshes import textured_wedge
from realsim.errors import InputError
from realsim.formats.bop.models import load_models, save_models
from realsim.geometry import se3
from realsim.geometry.mesh import diameter, mass_properties, merged
from realsim.geometry.parts import part
from realsim.models import library_complete, library_files
from realsim.models import model_picture_views as views
from realsim.models.library import ModelLibrary
from realsim.models.library_complete import complete
from realsim.models.library_files import read_properties
from realsim.models.library_prepare import Matter, PrepareConfig, prepare_mesh, prepare_unscaled
from realsim.models.library_reading import check_library
from realsim.models.library_session import copy_models, known_solids
from realsim.models.model_records import ConvexParts, ModelProperties, ScaleNote
from realsim.models.pictures import PANEL, figure_lines, model_sheet
from realsim.records import Mesh
from realsim.store.atomic import only_run_in
from realsim.untrusted.own_json import to_json
from refusals import refused

CONFIG = PrepareConfig()


@cache
def made(name: str):
    """A prepared part; made once."""
    return prepare_mesh(part(name).mesh, CONFIG)


@pytest.fixture
def library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModelLibrary:
    # Pictures have tests of their own, and take longer than all that is tested here.
    monkeypatch.setattr("realsim.models.pictures.sheet_png", lambda *_: b"picture")
    return ModelLibrary.create(tmp_path / "models")


# --- what goes in comes out -------------------------------------------------------------------


@pytest.mark.parametrize("name", ["box", "cone"])
def test_a_model_comes_back_as_it_went_in(library: ModelLibrary, name: str):
    given = made(name)
    library.add(given, name, picture=b"a picture")
    back = ModelLibrary.open(library.folder).load(name)
    assert np.allclose(back.model.mesh.vertices, given.mesh.vertices, rtol=0, atol=1e-8)
    assert np.array_equal(back.model.mesh.faces, given.mesh.faces)
    assert np.array_equal(back.model.mesh.colors, given.mesh.colors)
    assert back.properties is not None and back.parts is not None and given.parts is not None
    symmetries = given.properties.symmetries
    assert symmetries is not None
    assert np.allclose(back.model.symmetries, symmetries.discrete, atol=1e-12)
    assert np.shape(back.model.symmetry_axes) == np.shape(symmetries.axes)
    assert np.allclose(back.model.symmetry_axes, symmetries.axes, rtol=0, atol=1e-15)
    assert len(back.parts.parts) == len(given.parts.parts)
    for a, b in zip(back.parts.parts, given.parts.parts, strict=True):
        assert np.allclose(np.sort(a, axis=0), np.sort(b, axis=0), rtol=0, atol=1e-8)
    expected = replace(given.properties, name=name, obj_id=1, files=back.properties.files)
    assert to_json(back.properties) == json.loads(json.dumps(to_json(expected)))
    assert (library.folder / f"pictures/{name}.png").read_bytes() == b"a picture"
    assert check_library(library) == []


def sorted_corners(mesh: Mesh):
    """Return position and texture coordinates of every face's corners, in order."""
    assert mesh.uv is not None
    found = np.concatenate([mesh.vertices, mesh.uv], 1)[mesh.faces].reshape(-1, 5)
    return found[np.lexsort(np.round(found, 5).T)]


def test_a_texture_comes_back_bit_for_bit(library: ModelLibrary):
    mesh = textured_wedge()
    library.add(prepare_mesh(mesh, CONFIG), "painted")
    back = library.load("painted").model.mesh
    assert np.array_equal(back.texture, mesh.texture)
    # The repair may order vertices anew: every corner keeps its place on the texture.
    assert np.allclose(sorted_corners(back), sorted_corners(mesh), atol=1e-6)


def test_any_bop_reader_reads_the_library(library: ModelLibrary):
    library.add(made("cone"), "cone", obj_id=7)
    library.add(made("box"), "box")
    assert {i: m.name for i, m in load_models(library.folder).items()} == {7: "cone", 8: "box"}
    info = json.loads((library.folder / "models_info.json").read_text())
    assert list(info) == ["7", "8"]
    assert info["7"]["diameter"] == pytest.approx(1e3 * diameter(part("cone").mesh), rel=1e-3)
    assert len(info["7"]["symmetries_continuous"]) == 1


# --- mass -------------------------------------------------------------------------------------


def open_box() -> Mesh:
    """A box without its top: no hole that a repair may close."""
    x, y, z = 0.03, 0.04, 0.05
    v = np.array([[a, b, c] for a in (-x, x) for b in (-y, y) for c in (-z, z)])
    f = [[0, 2, 6], [0, 6, 4], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 1, 3], [0, 3, 2],
         [4, 6, 7], [4, 7, 5]]  # fmt: skip
    return Mesh(vertices=v, faces=np.array(f))


@pytest.mark.parametrize("mesh", [part("wedge").mesh, open_box()])
def test_every_stage_gets_the_weighed_mass(library: ModelLibrary, mesh: Mesh):
    # The search for the parts of an open box takes long, and any parts will do.
    quick = replace(CONFIG, convex=replace(CONFIG.convex, time_limit_s=1.0))
    model = library.add(prepare_mesh(mesh, quick, Matter(mass_kg=0.321)), "weighed").model
    assert mass_properties(model.mesh, model.density).mass_kg == pytest.approx(0.321, rel=1e-5)
    solid, why = library.solid(1)
    assert solid is not None and why == "" and solid.matter.mass_kg == pytest.approx(0.321)


# --- names and ids ----------------------------------------------------------------------------


def test_ids_are_given_once_and_never_changed(library: ModelLibrary):
    assert library.add(made("box"), "box").model.obj_id == 1
    assert library.add(made("wedge"), "wedge", obj_id=5).model.obj_id == 5
    assert library.next_id() == 6
    before = bytes_of(library.folder)
    refused(r"object 1 .* is 'box'.*--overwrite", library.add, made("wedge"), "box")
    refused(r"object 5 .* is 'wedge'", library.add, made("box"), "other", obj_id=5)
    refused("not renumbered to 9", library.add, made("box"), "box", obj_id=9, overwrite=True)
    assert bytes_of(library.folder) == before
    assert library.add(made("wedge"), "box", overwrite=True).model.obj_id == 1
    assert [e.name for e in library.entries()] == ["box", "wedge"]


def test_replacing_leaves_nothing_of_the_old_model(library: ModelLibrary):
    library.add(prepare_mesh(textured_wedge(), CONFIG), "old", picture=b"old")
    assert (library.folder / "obj_000001.png").is_file()
    plain = prepare_mesh(part("box").mesh, replace(CONFIG, with_parts=False))
    library.add(plain, "new", obj_id=1, overwrite=True)
    assert sorted(bytes_of(library.folder)) == [
        "models_info.json", "obj_000001.ply", "properties/obj_000001.json",
    ]  # fmt: skip
    assert check_library(library) == []


def test_names_that_cannot_be_files_are_refused(library: ModelLibrary):
    for name in ("", "12", "a/b", "..", "a b", ".hidden", "x" * 90, "mug."):
        refused("cannot be the name", library.add, made("box"), name)


def test_other_folders_are_no_libraries(tmp_path: Path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home/thesis.tex").write_text("x")
    refused(r"thesis\.tex", ModelLibrary.create, tmp_path / "home")
    refused(r"no models_info\.json", ModelLibrary.open, tmp_path / "home")
    save_models(tmp_path / "bop/models", {1: part("box")})
    refused("Did you mean", ModelLibrary.open, tmp_path / "bop")


# --- kills, other writers, damage -------------------------------------------------------------


@pytest.mark.parametrize("name", ["box", "another"])
def test_a_kill_leaves_the_library_old_or_new(tmp_path: Path, name: str):
    ModelLibrary.create(tmp_path / "old").add(made("box"), "box", picture=b"old")
    wedge = made("wedge")

    def changing(library: ModelLibrary) -> int:
        return library.add(wedge, name, overwrite=True, picture=b"new").model.obj_id

    new_id = changing(ModelLibrary(shutil.copytree(tmp_path / "old", tmp_path / "new")))
    old, new = bytes_of(tmp_path / "old"), bytes_of(tmp_path / "new")
    outcomes: set[str] = set()
    for step in range(100):
        folder = shutil.copytree(tmp_path / "old", tmp_path / f"killed_{step}")
        was_killed = killed_at(step, partial(changing, ModelLibrary(folder)))
        # A BOP reader that knows nothing of the change in flight reads it all the same.
        assert 1 in load_models(folder)
        library = ModelLibrary.open(folder)
        assert all(f.is_harmless for f in check_library(library))
        now = {k: v for k, v in bytes_of(folder).items() if not k.startswith(".adding")}
        assert now in (old, new)
        outcomes.add("old" if now == old else "new")
        # The next writer goes on as if nothing had been.
        changing(library)
        assert bytes_of(folder) == new
        if not was_killed:
            break
    assert step > 6 and outcomes == {"old", "new"} and new_id in (1, 2)


def test_writers_wait_for_each_other(library: ModelLibrary):
    given = made("box")

    def add(letter: str) -> None:
        for k in range(4):
            library.add(given, f"{letter}{k}")

    assert in_children(partial(add, "a"), partial(add, "b"))
    entries = library.entries()
    assert sorted(e.name for e in entries) == [f"{x}{k}" for x in "ab" for k in range(4)]
    assert [e.obj_id for e in entries] == list(range(1, 9))
    assert check_library(library) == []


def test_a_writer_that_never_ends_is_named(library: ModelLibrary, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(library_files, "WAIT_S", 0.1)
    with only_run_in(library.folder), pytest.raises(InputError, match="another run"):
        library.add(made("box"), "box")
    assert library.entries() == []


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda text: text[: len(text) // 2], "not valid JSON"),
        (lambda text: re.sub('"(doubtful|accepted)"', '"fine"', text),
         "'fine' - at `verdict`; accepted: accepted, "),
        (lambda text: text.replace('"format": 1', '"format": 99'), "format 99"),
    ],
)  # fmt: skip
def test_damaged_properties_cost_only_the_properties(library: ModelLibrary, damage, said: str):
    library.add(made("box"), "box")
    path = library.folder / "properties/obj_000001.json"
    path.write_text(damage(path.read_text()))
    refused(said, read_properties, path)
    back = library.load("box")
    assert back.properties is None and back.parts is None and said in back.notes[0]
    findings = check_library(library)
    assert [(f.kind, f.path) for f in findings] == [("damaged", "properties/obj_000001.json")]


def test_what_was_changed_missing_or_left_over_is_found(library: ModelLibrary):
    for name in ("box", "wedge"):
        library.add(made(name), name)
    folder = library.folder
    ply = folder / "obj_000001.ply"
    ply.write_bytes(ply.read_bytes() + b"\0")
    (folder / "collision/obj_000002.obj").unlink()
    (folder / "obj_000009.ply").write_bytes(b"ply")
    (folder / "properties/obj_000009.json").write_text("{}")
    (folder / "unscaled/half").mkdir(parents=True)
    kinds = {f.path: f.kind for f in check_library(library)}
    orphans = ("obj_000009.ply", "properties/obj_000009.json", "unscaled/half")
    faults = {"obj_000001.ply": "changed", "collision/obj_000002.obj": "missing"}
    assert kinds == faults | dict.fromkeys(orphans, "orphan")
    for obj_id, fault in enumerate(faults.values(), start=1):
        solid, why = library.solid(obj_id)
        assert solid is None and fault in why
    # The number of an orphan is not given to another model.
    assert library.next_id() == 10


# --- other programs' folders ------------------------------------------------------------------


def test_a_foreign_models_folder_is_a_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(library_complete, "sheet_png", lambda *_: b"picture")
    models = {3: replace(part("box"), obj_id=3), 4: replace(part("cone"), obj_id=4)}
    save_models(tmp_path, models)
    before = bytes_of(tmp_path)
    library = ModelLibrary.open(tmp_path)
    back = library.load("box")
    assert back.properties is None and back.parts is None and "not imported" in back.notes[0]
    assert [f.kind for f in check_library(library)] == ["foreign", "foreign"]
    found = complete(library, 3, CONFIG)
    assert found.properties is not None and found.parts is not None and found.notes == ()
    assert np.array_equal(found.properties.symmetries.discrete, models[3].symmetries)
    after = bytes_of(tmp_path)
    assert {k: after[k] for k in before} == before
    assert set(after) - set(before) == {
        "collision/obj_000003.obj", "pictures/box.png", "properties/obj_000003.json",
    }  # fmt: skip
    assert [f.kind for f in check_library(library)] == ["foreign"]


# --- Models without scale become metric ones; sessions get what they need of a library.

BARE = PrepareConfig(with_parts=False)


# --- without metric scale ---------------------------------------------------------------------


def test_promoting_equals_importing_at_that_size(library: ModelLibrary):
    scale = 0.37
    mesh = textured_wedge()
    raw = replace(mesh, vertices=mesh.vertices / scale)
    library.add_unscaled(prepare_unscaled(raw, BARE), "scan", picture=b"p")
    refused("without metric scale: `realsim scan scale scan", library.find, "scan")
    held = library.load_unscaled("scan")
    assert np.allclose(held.mesh.extent, raw.extent, rtol=1e-6)
    assert np.array_equal(held.mesh.texture, raw.texture)
    note = ScaleNote(scale=scale, sigma_percent=0.3, verdict="accepted", session="s1", how="fit")
    up = library.promote("scan", note, BARE)
    same = prepare_mesh(mesh, BARE)
    assert up.properties is not None and up.properties.matter is not None
    assert same.properties.matter is not None
    assert np.allclose(up.model.mesh.extent, mesh.extent, rtol=1e-5)
    assert up.properties.matter.mass_kg == pytest.approx(same.properties.matter.mass_kg, rel=1e-4)
    assert up.scale is not None and to_json(up.scale) == to_json(note)
    assert len(up.model.symmetries) == len(same.properties.symmetries.discrete)
    # It can be promoted again, by a better session, only if that is asked for.
    refused("--overwrite", library.promote, "scan", note, BARE)
    better = library.promote("scan", replace(note, scale=1.01 * scale), BARE, overwrite=True)
    assert better.model.obj_id == up.model.obj_id
    assert np.allclose(better.model.mesh.extent, 1.01 * mesh.extent, rtol=1e-5)


def test_a_doubtful_scale_makes_a_doubtful_model(library: ModelLibrary):
    library.add_unscaled(prepare_unscaled(part("wedge").mesh, BARE), "scan")
    note = ScaleNote(scale=1.0, verdict="doubtful", reasons=("seen from one side only",))
    up = library.promote("scan", note, BARE)
    assert up.properties is not None and up.properties.verdict == "doubtful"
    assert "seen from one side only" in up.properties.reasons[0]


def test_a_model_without_scale_is_no_bop_model(library: ModelLibrary):
    raw = prepare_unscaled(part("wedge").mesh, BARE)
    refused("no metric scale", library.add, raw, "scan")
    library.add_unscaled(raw, "scan")
    refused("already in", library.add_unscaled, raw, "scan")
    refused("there are: scan", library.load_unscaled, "cup")


def test_nonsense_scales_are_refused():
    for bad in (0.0, float("nan"), -1.0):
        refused("positive", ScaleNote, scale=bad)


# --- into a session ---------------------------------------------------------------------------


def test_a_session_gets_what_it_needs_and_no_more(library: ModelLibrary, tmp_path: Path):
    for name in ("box", "wedge", "tube"):
        library.add(made("wedge"), name)
    session = tmp_path / "session/models"
    there = r"object 8, 9 is not in .*box \(1\), wedge \(2\)"
    refused(there, copy_models, library, [1, 8, 9], session)
    assert not session.exists()
    assert copy_models(library, [3, 1, 1], session) == (1, 3)
    assert sorted(load_models(session)) == [1, 3]
    taken = {k: v for k, v in bytes_of(session).items() if "info" not in k}
    assert taken.items() <= bytes_of(library.folder).items()
    solids, unknown = known_solids(session, [1, 3])
    assert sorted(solids) == [1, 3] and unknown == {}
    table = (session / "models_info.json").read_bytes()
    (session / "models_info.json").unlink()  # as a copy leaves it that is ended
    assert copy_models(library, [1, 3], session) == (1, 3)
    assert (session / "models_info.json").read_bytes() == table
    library.add(prepare_mesh(part("box").mesh, BARE), "box", overwrite=True)
    assert copy_models(library, [1, 2, 3], session) == (2,)
    assert load_models(session)[1].mesh.extent == pytest.approx(part("wedge").mesh.extent, rel=1e-6)
    (session / "obj_000003.ply").write_bytes((session / "obj_000001.ply").read_bytes() + b"x")
    solids, unknown = known_solids(session, [1, 3])
    assert sorted(solids) == [1] and "changed" in unknown[3]


def test_a_lab_session_knows_nothing_and_says_nothing(tmp_path: Path):
    save_models(tmp_path, {1: part("box")})
    assert known_solids(tmp_path, [1]) == ({}, {})


# --- the sheet of a model -----------------------------------------------------------------------


UNKNOWN = ModelProperties(name="thing", verdict="accepted")
SIZE = (160, 120)


def test_open_rims_are_red_and_closed_meshes_have_none():
    mesh = part("tube").mesh
    assert views.rim_layer(mesh, 1.0).lines == ()
    cut = replace(mesh, faces=mesh.faces[np.arange(len(mesh.faces)) % 40 != 0])
    assert len(views.rim_layer(cut, 1.0).lines) > 30
    off = np.abs(model_sheet(cut, UNKNOWN).astype(int) - [224, 27, 36])
    assert np.sum(np.all(off < 12, axis=-1)) > 200


@pytest.mark.slow
def test_every_part_has_its_colour():
    cube = part("cube").mesh
    beside = replace(cube, vertices=cube.vertices + np.array([0.05, 0, 0]))
    mesh = replace(merged([cube, beside]), colors=None)
    parts = ConvexParts(parts=(cube.vertices, beside.vertices), volume_ratio=1.0, method="hull")
    sheet = model_sheet(mesh, UNKNOWN, parts)
    r, g, b = np.moveaxis(sheet[: sheet.shape[0] // 2, 2 * PANEL[0] :].astype(int), -1, 0)
    for stronger in (b - r, r - b):  # blue, orange
        assert np.sum((stronger > 60) & (g > 60)) > 2000


def test_a_pixel_is_as_wide_as_the_scale_bar_says():
    drawn, factor = views.drawn_size(part("cube").mesh)
    view = views.view_of(drawn.vertices, (0.0, -1.0, 0.0), SIZE)
    _, depth = views.rendered([drawn], view)
    wide_px = np.ptp(np.nonzero(depth > 0)[1]) + 1
    # Perspective: the front face is nearer than the middle, for which the bar holds.
    nearer = view.T_obj_cam[1, 3] / (view.T_obj_cam[1, 3] + 0.025 * factor)
    assert wide_px / (view.px_per_m * factor) == pytest.approx(0.05 * nearer, rel=0.02)


@pytest.mark.parametrize(
    ("name", "orders"), [("cube", {4: 3, 3: 4, 2: 6}), ("hex_nut", {6: 1, 2: 6}), ("wedge", {})]
)
def test_the_axes_of_known_shapes(name: str, orders: dict[int, int]):
    symmetries = part(name).symmetries
    found = [order for order, _, _ in views.rotation_axes(symmetries)]
    assert {n: found.count(n) for n in set(found)} == orders
    # Equivariance: where the object is put, its axes go along.
    T = se3.from_rt(se3.exp_so3([0.4, -0.9, 0.3]), [0.2, -0.1, 0.5])
    moved = views.rotation_axes(T @ symmetries @ se3.invert(T))
    for order, direction, point in moved:
        S = se3.from_rt(R := se3.exp_so3(2 * np.pi / order * direction), point - R @ point)
        assert min(np.abs(T @ A @ se3.invert(T) - S).max() for A in symmetries) < 1e-6


def test_problems_are_written_on_the_sheet():
    reason = "open: 24 boundary edges in 2 holes"
    p = prepare_unscaled(part("wedge").mesh, CONFIG).properties
    p = replace(p, verdict="doubtful", reasons=(reason,))
    lines = figure_lines(part("wedge").mesh, p)
    assert ("look", reason) in lines
    assert any("no metric scale" in text for _, text in lines)
