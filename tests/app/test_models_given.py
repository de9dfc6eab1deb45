"""Data sets without meshes: every command says what to give, and takes it alike."""

import shutil

import pytest

import refusals
from labelled_scenes import MODELS, labelled_scene, written_graspnet
from realsim.app.console import Console
from realsim.app.school.inputs import SchoolRequest, read_inputs
from realsim.app.upgrade.dataset import UpgradeConfig, open_scene, scenes_of
from realsim.app.upgrade.source import prepare
from realsim.formats.bop.models import load_models, save_models
from typed_commands import finished, refused


@pytest.fixture(scope="module")
def frame(tmp_path_factory):
    """One image as graspnet-baseline's demo has it, its meshes in two layouts elsewhere."""
    home = tmp_path_factory.mktemp("frame")
    written_graspnet(home / "tree", labelled_scene(home / "images", [0]))
    camera, image = home / "tree/scenes/scene_0003/realsense", home / "frame"
    image.mkdir()
    for source, name in (("rgb", "color.png"), ("depth", "depth.png"), ("meta", "meta.mat")):
        shutil.copy(next((camera / source).glob("0000.*")), image / name)
    shutil.copytree(home / "tree/models", home / "as_graspnet")
    save_models(home / "as_bop", MODELS)
    return image


def school_of(frame, out, models):
    return read_inputs(frame, out, SchoolRequest(models=models), Console(quiet=True))


def upgrade_of(frame, models):
    (ref,) = scenes_of(frame, config := UpgradeConfig(models=models))
    return prepare(open_scene(ref), ref, config)


def test_every_command_says_what_to_give(frame, tmp_path):
    said = " ".join(finished("import", frame, tmp_path / "s", "--quiet").output.split())
    assert "register" in said
    school = refusals.refused(".", school_of, frame, tmp_path / "o", None)
    for told in (said, school, refusals.refused(".", upgrade_of, frame, None)):
        assert "000, 006, 029" in told and "--models FOLDER" in told
    wrong = refused("import", frame, tmp_path / "t", "--models", frame, "--quiet")
    assert "none of them" in wrong
    assert not (tmp_path / "t").exists()


@pytest.mark.parametrize("layout", ["as_graspnet", "as_bop"])
def test_meshes_that_are_given_go_through_all_commands(frame, tmp_path, layout):
    models, session = frame.parent / layout, tmp_path / "s"
    finished("import", frame, session, "--quiet")
    finished("import", frame, session, "--models", models, "--quiet")
    assert load_models(session / "models").keys() == MODELS.keys()
    tried = school_of(frame, tmp_path / "o", models)
    assert sorted(o.obj_id for o in tried.scene.objects) == sorted(MODELS)
    assert tried.scene.plane is not None
    ready = upgrade_of(frame, models)
    assert ready.models.keys() == MODELS.keys() and len(ready.seen[0]) == 3
