"""`realsim scan scale`: what it refuses, what it writes, and what it says first."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import typed_commands
from begun_sessions import begun
from realsim.app.console import Console
from realsim.app.scan.scale import inputs
from realsim.app.scan.scale.cli import RESULT
from realsim.app.scan.scale.inputs import NamedMesh, ScaleRequest, read_mesh, usable_views
from realsim.app.scan.scale.run import Place, run_scale, view_poses, write_result
from realsim.app.scan.scale.show import model_lines
from realsim.errors import InputError, UnitError
from realsim.geometry.mesh import load_mesh, save_ply
from realsim.geometry.parts import object_model
from realsim.models.library import ModelLibrary
from realsim.models.library_prepare import PrepareConfig, prepare_unscaled
from realsim.models.model_records import ScaleNote
from realsim.records import View
from realsim.scanning.scale.files import ScaleRecord, installed_versions
from realsim.scanning.scale.measured import length_of, parse_measurement
from realsim.store import SessionStore
from refusals import refused
from scale_fits import UNIT_M, fit_of, known_scan
from typed_commands import invoked

CONSOLE = Console(quiet=True)


@pytest.fixture(scope="module")
def known():
    return known_scan("mug", 2)


@pytest.fixture(scope="module")
def fit(known):
    return fit_of(known)


def session_of(known, folder: Path, *, depth=True, posed=True) -> SessionStore:
    """A captured session of the known views."""
    camera = known.views.intrinsics
    store = begun(folder, camera)
    for f in known.views.frames:
        rgb = np.full((camera.height, camera.width, 3), 40 * f.index % 200, np.uint8)
        store.add_view(View(index=f.index), rgb, f.depth_m if depth else None)
    if posed:
        store.set_cameras(camera, {f.index: f.T_world_cam for f in known.views.frames})
    store.close()
    return store


@pytest.fixture
def session(known, tmp_path):
    return session_of(known, tmp_path / "session")


@pytest.fixture
def mesh_file(known, tmp_path):
    save_ply(tmp_path / "mug.ply", known.scan, "m")
    return tmp_path / "mug.ply"


def named_of(known) -> NamedMesh:
    sha256 = inputs.mesh_hash(known.scan)
    return NamedMesh(mesh=known.scan, name="mug", origin="file", where="mug.ply", sha256=sha256)


def inputs_of(request, named, session):
    views = usable_views(session, request.views)
    return inputs.inputs_of(request, named, session, views, inputs.fit_config(session))


def record_of(request, named, session, fit) -> ScaleRecord:
    """What a run keeps of its fit."""
    given = inputs_of(request, named, session)
    return ScaleRecord(fit=fit, inputs=given, versions=installed_versions())


# --- what is refused --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kept", "wanted", "said"),
    [
        ({"depth": False}, (), r"none with depth.*--measured"),
        ({"posed": False}, (), r"not calibrated.*realsim calibrate"),
        ({}, (1, 2, 7, 3, 9), r"no view 7, 9; its views are 0-5"),
    ],
)
def test_views_that_do_not_do_are_named(known, tmp_path, kept, wanted, said):
    store = session_of(known, tmp_path / "s", **kept)
    refused(said, usable_views, store, wanted)
    if not kept:
        assert [v.index for v in usable_views(store, (5, 1, 3))] == [1, 3, 5]
        assert len(usable_views(store, ())) == 6


def test_a_damaged_depth_image_is_named(mesh_file, session):
    path = session.path("depth/000002.png")
    path.write_bytes(path.read_bytes()[:-20])
    request = ScaleRequest(mesh=str(mesh_file), session=session.folder)
    refused("000002", run_scale, request, CONSOLE)


def test_a_mesh_without_anything_that_knows_metres_is_refused():
    refused("SESSION.*--measured", run_scale, ScaleRequest(mesh="mug.ply"), CONSOLE)


@pytest.mark.parametrize(
    ("option", "value", "error", "said"),
    [
        ("--rough-size", "90", UnitError, "no unit"),
        ("--between", "0,0,0=95mm", InputError, "two different"),
        ("--at", "0.4", InputError, "x,y in metres"),
        ("--at", "400,-50", InputError, "millimetres"),
        ("--start-file", "none.json", InputError, "does not exist"),
    ],
)
def test_what_cannot_be_read_is_named(option, value, error, said):
    why = invoked("scan", "scale", "mug.ply", option, value).exception
    assert isinstance(why, error) and said in str(why)


# --- a mesh of the library --------------------------------------------------------------------


@pytest.fixture
def library(tmp_path):
    """A library with a box that waits for its scale."""
    box = object_model("box").mesh
    made = prepare_unscaled(replace(box, vertices=box.vertices / UNIT_M), PrepareConfig())
    library = ModelLibrary.create(tmp_path / "models")
    library.add_unscaled(made, "box")
    return library


@pytest.mark.slow
def test_a_name_in_both_is_the_mesh_without_scale_and_the_id_is_the_model(library):
    note = ScaleNote(scale=UNIT_M, sigma_percent=0.3, verdict="accepted")
    obj_id = library.promote("box", note, PrepareConfig(with_parts=False)).model.obj_id
    request = ScaleRequest(mesh="box", library=library.folder)
    named = read_mesh(request)
    assert named.origin == "unscaled" and named.scaled_id == obj_id
    assert f"scan scale {obj_id} SESSION" in named.notes[-1]
    said = model_lines(named, Path("model.ply"), "accepted", is_stored=False)[1]
    assert f"box ({obj_id}) was not changed" in said and "--overwrite" in said
    assert read_mesh(replace(request, mesh="unscaled/box")).notes == ()
    model = read_mesh(replace(request, mesh=str(obj_id)))
    assert (model.origin, model.name) == ("model", "box")
    np.testing.assert_allclose(model.mesh.extent, UNIT_M * named.mesh.extent, rtol=1e-5)


# --- the hash of the inputs -------------------------------------------------------------------


def key_of(known, session, **changes):
    return inputs_of(ScaleRequest(mesh="mug.ply", **changes), named_of(known), session)["key"]


def test_the_key_changes_with_every_input_and_with_nothing_else(known, session):
    key = key_of(known, session)
    assert key == key_of(known, session, overwrite=True, out=Path("elsewhere"))
    m = parse_measurement("longest=120mm")
    measured = ({"measured": (m,)}, {"measured": (replace(m, sigma_m=2e-3),)})
    changes = ({"at": (0.1, 0.0)}, {"size_m": 0.1}, {"views": (0, 1, 2)}, *measured)
    others = [key_of(known, session, **change) for change in changes]
    session.set_cameras(known.views.intrinsics, {0: known.views.frames[1].T_world_cam})
    others.append(key_of(known, session))
    assert len({key, *others}) == len(others) + 1


# --- what is written --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(known, fit, tmp_path_factory):
    """A result in its session, as a fit leaves it; nobody changes it."""
    session = session_of(known, tmp_path_factory.mktemp("written") / "session")
    place = Place(session, session.folder / "scans/mug")
    record = record_of(ScaleRequest(mesh="mug.ply"), named_of(known), session, fit)
    record = replace(record, poses=view_poses(fit, usable_views(session, ())))
    write_result(place, record, named_of(known), session)
    return place, record, session


def test_every_file_is_there_and_listed_in_the_session(written):
    place, record, session = written
    names = {p.name for p in place.folder.iterdir()}
    assert {"scale.json", "scale.html", "residuals.png", "views.png", "overlays.png",
            "candidates.png", "model.ply"} <= names  # fmt: skip
    assert session.verify() == []
    path = place.folder / "scale.json"
    whole = path.read_bytes()
    try:
        path.write_text("{}")
        assert [f.path for f in session.verify()] == ["scans/mug/scale.json"]
        assert place.record(record.inputs["key"]) is None
    finally:
        path.write_bytes(whole)


def test_a_folder_whose_run_was_ended_is_its_own_and_not_finished(known, written, monkeypatch):
    place, record, session = written
    folder = Place(session, session.folder.parent / "out")
    write = Place.write

    def ended(self, name, data):
        if name == "scale.html":
            raise KeyboardInterrupt
        write(self, name, data)

    with monkeypatch.context() as patch:
        patch.setattr(Place, "write", ended)
        with pytest.raises(KeyboardInterrupt):
            write_result(folder, record, named_of(known), session)
    assert folder.record(record.inputs["key"]) is None
    assert RESULT.convert(folder.folder, None, None) == folder.folder
    write_result(folder, record, named_of(known), session)
    files = sorted(p.name for p in place.folder.iterdir())
    assert sorted(p.name for p in folder.folder.iterdir()) == files
    for name in {*files} - {"scale.html"}:
        assert (folder.folder / name).read_bytes() == (place.folder / name).read_bytes()


def test_the_page_begins_with_the_verdict_and_needs_nothing_else(written):
    place, record, _ = written
    text = (place.folder / "scale.html").read_text()
    body = text.split("<body>")[1]
    assert body.index(record.fit.verdict.upper()) < body.index("<table>")
    assert text.count("data:image/png;base64,") == 4
    assert not re.search(r'(src|href)="(?!data:)', text) and "@media print" in text
    for limit in record.fit.limits:
        assert limit.text in text


# --- whole runs -------------------------------------------------------------------------------


def test_the_scale_by_a_caliper_alone_is_unchecked(known, mesh_file, tmp_path):
    longest = UNIT_M * length_of(known.scan, parse_measurement("longest=1m"))
    measured = ("scan", "scale", mesh_file, "--measured", f"longest={1e3 * longest}mm")
    words = (*measured, "--out", tmp_path / "out", "--json-file", tmp_path / "s.json", "--quiet")
    first = invoked(*words)
    (tmp_path / "out/model.ply").unlink()  # as if it had been ended before
    assert first.exit_code == invoked(*words).exit_code == 1
    assert "--overwrite" in typed_commands.refused(*words)
    said = first.stdout
    assert said.startswith("UNCHECKED: mug") and "model.ply in mm" in said
    assert "--library models --accept-doubtful" in said
    data = json.loads((tmp_path / "s.json").read_text())
    assert data["verdict"] == "unchecked" and data["scale"] == pytest.approx(UNIT_M, rel=1e-4)
    assert data == json.loads((tmp_path / "out/scale.json").read_text())
    assert data["smallest_box_mm"][0] == pytest.approx(1e3 * longest, rel=1e-4)
    mesh = load_mesh(tmp_path / "out/model.ply", "mm")
    np.testing.assert_allclose(mesh.extent.max(), UNIT_M * known.scan.extent.max(), rtol=1e-3)


def test_a_second_run_finds_the_first(known, fit, session, mesh_file, capsys):
    request = ScaleRequest(mesh=str(mesh_file), session=session.folder)
    named = read_mesh(request)
    # As stored by PLY, in float32: the residuals are of these vertices.
    accepted = replace(fit, verdict="accepted", reasons=())
    record = record_of(request, named, session, accepted)
    write_result(Place(session, session.folder / "scans/mug"), record, named, session)
    before = (session.folder / "scans/mug/scale.json").stat().st_mtime_ns
    assert run_scale(request, CONSOLE)
    said = capsys.readouterr().out
    assert "nothing has changed" in said
    assert (session.folder / "scans/mug/scale.json").stat().st_mtime_ns == before
    # Nothing went into a library, and no caliper was asked: both are said, the caliper last.
    assert "library   none: --library models" in said
    assert "--measured longest=...mm" in said.splitlines()[-1]


@pytest.mark.slow
def test_an_accepted_scale_goes_into_the_library(tmp_path):
    known = known_scan("box", 2)  # convex: its parts take no time
    fit, session = fit_of(known), session_of(known, tmp_path / "session")
    save_ply(tmp_path / "box.ply", known.scan, "m")
    request = ScaleRequest(
        mesh=str(tmp_path / "box.ply"), session=session.folder, library=tmp_path / "models"
    )
    named = read_mesh(request)
    place = Place(session, session.folder / "scans/box")
    doubtful = replace(fit, verdict="doubtful", reasons=("two scales.",))
    write_result(place, record_of(request, named, session, doubtful), named, session)
    assert not run_scale(request, CONSOLE)
    assert not (tmp_path / "models").exists()
    assert not run_scale(replace(request, accept_doubtful=True), CONSOLE)
    kept = ModelLibrary.open(tmp_path / "models").load("box")
    assert kept.scale is not None and kept.scale.verdict == "doubtful"
    assert kept.scale.scale == fit.scale and kept.scale.session == session.session.name
    np.testing.assert_allclose(kept.model.mesh.extent, UNIT_M * known.scan.extent, rtol=1e-3)
    request = ScaleRequest(mesh="boxx", library=tmp_path / "models")
    refused("neither a file nor a model.*box", read_mesh, request)
