"""Models without metric scale become models with one; sessions get what they need of a library."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from file_trees import bytes_of
from plain_meshes import textured_wedge
from realsim.errors import InputError
from realsim.formats.bop.models import load_models, save_models
from realsim.geometry.parts import part
from realsim.models.library import ModelLibrary
from realsim.models.library_prepare import PrepareConfig, prepare_mesh, prepare_unscaled
from realsim.models.library_records import ScaleNote
from realsim.models.library_session import copy_models, known_solids
from realsim.untrusted.own_json import to_json
from refusals import refused

BARE = PrepareConfig(with_parts=False)


@pytest.fixture
def library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModelLibrary:
    # Pictures have tests of their own, and take longer than all that is tested here.
    monkeypatch.setattr("realsim.models.pictures.sheet_png", lambda *_: b"picture")
    return ModelLibrary.create(tmp_path / "models")


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
    made = prepare_mesh(part("wedge").mesh, PrepareConfig())
    for name in ("box", "wedge", "tube"):
        library.add(made, name)
    session = tmp_path / "session/models"
    with pytest.raises(InputError, match=r"object 8, 9 is not in .*box \(1\), wedge \(2\)"):
        copy_models(library, [1, 8, 9], session)
    assert not session.exists()
    assert copy_models(library, [3, 1, 1], session) == (1, 3)
    assert sorted(load_models(session)) == [1, 3]
    taken = bytes_of(session)
    assert {
        k: v for k, v in bytes_of(library.folder).items() if k in taken and "info" not in k
    } == {k: v for k, v in taken.items() if "info" not in k}
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
