"""A command on several sessions: each by a process, failures named, the rest done."""

import json
import shutil

import pytest

from file_trees import bytes_of
from synthetic_scenes import captured_session
from typed_commands import finished, invoked, refused


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    folder = tmp_path_factory.mktemp("many")
    first = captured_session(folder / "a", 2).folder
    shutil.copytree(first, folder / "b")
    (folder / "c").mkdir()
    return [first, folder / "b", folder / "c"]


def labels(session):
    return bytes_of(session, "mask/*.png", "annotations/*.json")


def test_each_session_is_done_and_the_one_that_fails_is_named(sessions, tmp_path):
    alone = tmp_path / "alone"
    shutil.copytree(sessions[0], alone)
    finished("annotate", alone, "--maps", "none", "--workers", "1", "--quiet")
    done = invoked("annotate", *sessions, "--maps", "none", "--workers", "2", "--json", "--quiet")
    assert done.exit_code == 1, done.output
    document = json.loads(done.stdout)
    assert document["done"] == {str(s): 0 for s in sessions[:2]}
    assert list(document["failed"]) == [str(sessions[2])]
    assert "session.json" in document["failed"][str(sessions[2])]
    assert labels(sessions[0]) == labels(sessions[1]) == labels(alone) and labels(alone)


@pytest.mark.slow
def test_sessions_that_travel_to_a_cluster_come_back_as_if_they_had_stayed(sessions, tmp_path):
    pytest.importorskip("ray")
    before = {p for p in sessions[0].rglob("*") if p.is_file()}
    places = [tmp_path / name for name in ("here", "a", "b")]
    for place in places:
        shutil.copytree(sessions[0], place)
    words = ("--library", sessions[0] / "models", "--views", "2", "--quiet")
    objects = ("--object", "1", "--object", "7")
    here = invoked("register", places[0], *objects, *words)
    ray = ("--address", "local", "--workers", "1", "--json")
    done = invoked("register", *places[1:], *objects, *words, *ray)
    assert here.exception is None or isinstance(here.exception, SystemExit), here.exception
    code = here.exit_code
    assert done.exit_code == code and code in (0, 1), done.output
    assert json.loads(done.stdout)["done"] == {str(p): code for p in places[1:]}
    scenes = [json.loads((p / "registration/scene.json").read_text()) for p in places]
    poses = [[o["T_world_obj"] for o in s["objects"]] for s in scenes]
    assert poses[0] and poses[1] == poses[2] == poses[0]
    # A process that has a model's distance field in memory keeps none in the cache.
    files = [
        {p.relative_to(place) for p in place.rglob("*") if p.is_file() and p.parent.name != "cache"}
        for place in places
    ]
    assert files[1] == files[2] == files[0] and len(files[0]) > len(before)


def test_what_cannot_be_for_several_is_refused(sessions):
    for words, told in (
        (("annotate", sessions[0], sessions[0]), "given twice"),
        (("render", *sessions[:2], "--out", sessions[0].parent / "out"), "is one place"),
        (("school", *sessions[:2], "--json-file", sessions[0].parent / "x.json"), "--json-file"),
    ):
        assert told in refused(*words, "--quiet")
