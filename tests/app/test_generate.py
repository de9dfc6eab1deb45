"""`realsim generate`: data sets that go on after an interruption and repeat to the byte."""

import json
import shutil
import signal
from pathlib import Path

import pytest

from bop_scenes import edit
from file_trees import bytes_of
from typed_commands import finished, invoked, refused, started, wait_until

SMALL = ("--views", "2", "--size", "160x90", "--objects", "2-3", "--seed", "5", "--workers", "1",
         "--depth", "disparity", "--quiet")  # fmt: skip
UNREPEATED = (
    "session.json", "session.begun.json", "manifest.jsonl", "generate.json", "scene_gt_coco.json",
    "index.html",
)  # fmt: skip
"""Files that name the time at which they were begun or how long it took, lists of checksums."""


def _refusal(out: Path, *arguments: object) -> str:
    return refused("generate", out, *SMALL, *arguments)


def _content(folder: Path) -> dict[str, bytes]:
    return {
        name: data
        for name, data in bytes_of(folder).items()
        if Path(name).name not in UNREPEATED and not name.endswith((".finished.json", ".run.json"))
    }


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("generate") / "out"
    finished("generate", out, *SMALL, "--scenes", "1")
    return out


def test_a_scene_is_an_accepted_session_with_exact_labels(dataset: Path) -> None:
    scene = json.loads((dataset / "scene_000000/registration/scene.json").read_text())
    assert {o["verdict"] for o in scene["objects"]} == {"accepted"}
    session = json.loads((dataset / "scene_000000/session.json").read_text())
    assert "simulated" in session["extra"]["synthetic"]["provenance"]["poses"]
    for k in range(2):
        for name in ("rgb", "depth", "labels/instance"):
            assert (dataset / f"scene_000000/{name}/{k:06d}.png").is_file()


def test_the_data_set_says_what_was_used(dataset: Path) -> None:
    value = json.loads((dataset / "dataset.json").read_text())
    scene = value["scenes"][0]
    assert 2 <= len(scene["objects"]) <= 3
    assert all(0.02 <= o["size_m"] / scene["side_m"] <= 0.20 for o in scene["objects"])
    assert value["request"]["seed"] == 5
    assert value["statistics"]["views"] == 2
    assert sum(value["statistics"]["visibility"]["counts"]) > 0
    assert value["statistics"]["worst_moved_mm"] < 1.0
    assert (dataset / "contact_sheet.png").is_file()


def test_a_finished_scene_is_kept_and_a_view_that_is_missing_is_made_again(
    dataset: Path, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(dataset, tmp_path / "copy"))
    words = ("generate", out, *SMALL, "--scenes", "1")
    before = _content(out)
    assert "kept" in finished(*words).output
    assert _content(out) == before
    # What a registration made of the labels is not told as what was generated.
    labels = out / "scene_000000/scene_gt_info.json"
    edit(labels, lambda rows: rows["0"][0].update(visib_fract=0.123))
    written = {n: (out / n).read_bytes() for n in ("dataset.json", "index.html")}
    finished(*words)
    assert {n: (out / n).read_bytes() for n in written} == written
    shutil.copyfile(dataset / "scene_000000/scene_gt_info.json", labels)
    for name in ("rgb/000001.png", "annotations/000001.json"):
        (out / "scene_000000" / name).unlink()
    assert "made" in finished(*words).output
    # The list of views is only ever added to: the view that was taken again is there twice.
    after, lines = _content(out), "scene_000000/robot.jsonl"
    assert after | {lines: before[lines]} == before


@pytest.mark.slow
def test_a_run_that_is_killed_goes_on_to_the_bytes_that_seed_and_number_make(
    dataset: Path, tmp_path: Path
) -> None:
    out = tmp_path / "killed"
    arguments = [*SMALL, "--scenes", "2"]
    with started("generate", out, *arguments) as process:
        wait_until((out / "scene_000000/rgb/000000.png").is_file, process)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    finished("generate", out, *arguments, "--workers", "2")
    assert _content(out / "scene_000000") == _content(dataset / "scene_000000")
    more = shutil.copytree(dataset, tmp_path / "more")  # the other tests' dataset keeps its scene
    finished("generate", more, *arguments)
    assert _content(out) == _content(more)


# --- bad input --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--radius", "0.01-0.05"), "stand in the table"),
        (("--size", "1920"), "WIDTHxHEIGHT"),
        (("--size", "4x4"), "16 to 8192"),
        (("--objects", "2.5"), "whole numbers"),
        (("--object-sizes", "2-20"), "shares from 0.005 to 0.5"),
        (("--table", "desk"), "drawer_desk"),
        (("--hdris", "nowhere"), "--hdris 'nowhere' is no folder"),
        (("--depth-model", "fit.json", "--depth", "clean"), "--depth-model is for"),
    ],
)
def test_what_cannot_be_used_is_named_before_anything_is_made(
    tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    assert words in _refusal(tmp_path / "out", *arguments)
    assert not (tmp_path / "out").exists()


def test_a_folder_with_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert "not empty" in _refusal(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_a_folder_in_which_nothing_was_made_is_free_for_another_request(tmp_path: Path) -> None:
    pool, out = tmp_path / "pool", tmp_path / "out"
    pool.mkdir()
    (pool / "torn.obj").write_text("v 0 0\nf 1 2 3\n")
    arguments = ("--scenes", "1", "--pool", pool)
    result = invoked("generate", out, *SMALL, *arguments)
    assert result.exit_code == 1 and "no scene was made" in result.output
    assert "scene_000000 could not be made" in result.output and "torn.obj" in result.output
    (pool / "torn.obj").write_text("v 0 0\nf 1 2 3\nf 1 2 4\n")  # mended, as they think
    result = invoked("generate", out, *SMALL, *arguments)
    assert result.exit_code == 1, repr(result.exception)
    (out / "layouts").mkdir()
    (out / "layouts/scene_000000.json").write_text("{}")
    assert "seed (5 there, 6 wanted)" in _refusal(out, *arguments, "--seed", "6")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("text.hdr", b"hello", "is no hdr picture"),
        ("cube.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 64 +X 64\n", "is 64x64"),
    ],
)
def test_a_picture_that_is_no_panorama_is_named_before_anything_falls(
    tmp_path: Path, name: str, content: bytes, words: str
) -> None:
    (tmp_path / "skies").mkdir()
    (tmp_path / "skies" / name).write_bytes(content)
    said = _refusal(tmp_path / "out", "--hdris", tmp_path / "skies")
    assert name in said and words in said
    assert not (tmp_path / "out").exists()
