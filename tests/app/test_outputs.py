"""No output option replaces what its command did not write; a session without a header is told."""

import json
import os
from pathlib import Path

import click
import pytest

import refusals
from file_trees import bytes_of
from realsim.app.cli import commands
from realsim.app.command import walk
from realsim.app.outputs import INPUTS, OutputFile, OutputFolder, unguarded
from realsim.store import atomic
from synthetic_scenes import captured_session
from typed_commands import invoked, refused

NAMES = {"out", "dest", "static", "replay_file", "json_file"}
"""What parameters are called that say where a result goes."""
OUTPUTS = {
    f"{' '.join(path)} {parameter.opts[0]}": (path, parameter)
    for path, command in walk(commands).items()
    for parameter in command.params
    if parameter.name in NAMES
}
FILES = [name for name, (_, p) in OUTPUTS.items() if isinstance(p.type, OutputFile)]
FOLDERS = [
    name
    for name, (_, p) in OUTPUTS.items()
    if isinstance(p.type, OutputFolder) and not p.type.goes_on
]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return captured_session(tmp_path_factory.mktemp("outputs") / "s", count=2).folder


def convert(name: str, path: Path) -> Path:
    return OUTPUTS[name][1].type.convert(str(path), OUTPUTS[name][1], None)


def test_every_output_option_has_the_guard() -> None:
    kinds = {name: p.type for name, (_, p) in OUTPUTS.items()}
    assert not [n for n, kind in kinds.items() if not isinstance(kind, OutputFile | OutputFolder)]
    assert len(FILES) >= 8 and len(FOLDERS) >= 6
    # Whatever it is called: a path that is not known to be read is an output.
    everything = {**walk(commands), (): commands}
    loose = {(path, p.name) for path, c in everything.items() for p in c.params
             if unguarded(str(p.name), p)}  # fmt: skip
    assert not loose, "give it a type of realsim.app.outputs, or its name to INPUTS there"
    names = {p.name for c in everything.values() for p in c.params}
    assert names >= INPUTS, "names that no command has"


def test_an_option_that_goes_round_the_guard_is_seen() -> None:
    guarded = OutputFile({".json": ()}, "document")
    for kind in (click.Path(path_type=Path), click.File("w"), guarded):
        option = click.Option(["--save-to"], type=kind)
        assert unguarded("save_to", option) == (kind is not guarded)


@pytest.mark.parametrize("name", [n for n in OUTPUTS if n not in FILES])
def test_nothing_goes_into_data_or_through_a_link(name: str, session: Path, tmp_path: Path) -> None:
    outside, out = tmp_path / "outside", tmp_path / "out"
    outside.mkdir()
    out.mkdir()
    for path in (session / "rgb/more", session / "registration", session / "plan.json",
                 session / "session.json"):  # fmt: skip
        refusals.refused(r"part of the session|is a file", convert, name, path)
    assert convert(name, out) == out
    (out / "rgb").symlink_to(outside)
    refusals.refused("out of the folder", convert, name, out)
    link = tmp_path / "link"
    link.symlink_to(session / "rgb")
    refusals.refused("part of the session", convert, name, link)
    link.unlink()
    link.symlink_to(outside)
    refusals.refused(f"link' is a link to {outside}; nothing is written", convert, name, link)


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_the_command_did_not_write_is_refused(
    name: str, session: Path, tmp_path: Path
) -> None:
    before = bytes_of(session)
    suffix = next(iter(OUTPUTS[name][1].type.own))
    foreign, pipe, link = (tmp_path / f"{n}{suffix}" for n in ("mine", "pipe", "link"))
    foreign.write_text('{"my": "thesis"}')
    os.mkfifo(pipe)
    link.symlink_to(session / "session.json")
    others = (foreign, pipe, link, tmp_path, tmp_path / "no" / f"x{suffix}")
    for path in (*map(session.joinpath, before), *others):
        refusals.refused(".", convert, name, path)
    assert bytes_of(session) == before
    assert convert(name, tmp_path / f"new{suffix}") == tmp_path / f"new{suffix}"


@pytest.mark.parametrize("name", FOLDERS)
def test_a_session_is_no_folder_for_results(name: str, session: Path, tmp_path: Path) -> None:
    for path in (session, session / "registration", session / "rgb/more", session / "session.json"):
        refusals.refused(r"part of the session|is a file", convert, name, path)
    assert convert(name, session / "reports/more") and convert(name, tmp_path)
    refusals.refused("'/proc/x/y': /proc cannot be written ", convert, name, Path("/proc/x/y"))
    for file in OUTPUTS[name][1].type.files:
        (tmp_path / file).write_text("mine")
        refusals.refused("not replaced", convert, name, tmp_path)
        (tmp_path / file).unlink()


@pytest.mark.parametrize(
    "words",
    [
        ["stats", "S", "--json-file", "S/session.json"],
        ["review", "S", "--static", "S/session.json"],
        ["report", "S", "--out", "S/rgb/000000.png"],
        ["depth-fit", "S", "--out", "S/scene_camera.json"],
        ["stats", "S", "--out", "S"],
        ["calibrate", "P", "--board", "tag:7,size=80mm", "--out", "S/calibration"],
    ],
)
def test_nothing_of_a_session_is_lost(session: Path, tmp_path: Path, words: list[str]) -> None:
    before = bytes_of(session)
    typed = [w.replace("S", str(session), 1) if w[0] == "S" else w for w in words]
    refused(*(tmp_path if w == "P" else w for w in typed))
    assert bytes_of(session) == before


def test_a_calibration_of_other_images_is_not_replaced(tmp_path: Path) -> None:
    done = tmp_path / "calibration/exports"
    done.mkdir(parents=True)
    (done / "calibration.json").write_text("{}")
    call = ("calibrate", tmp_path, "--board", "tag:7,size=80mm", "--out", done.parent)
    assert "made by something else" in str(invoked(*call).exception)
    note = json.dumps({"images": str(tmp_path.resolve())})
    (done.parent / "calibrated_of.json").write_text(note)
    assert "made by something else" not in str(invoked(*call).exception)


@pytest.mark.parametrize("cameras", [[], ["--cameras", "wrist=hand"]], ids=["one", "several"])
@pytest.mark.parametrize(
    ("out", "said"),
    [
        ("lab", "is the data set itself"),
        (".", "lab is there, made by something else"),
        ("lab/wrist", "00.png is there, made by something else"),
        ("other", "camera_place.png is there, made by something else"),
        ("/proc/x", "--out '/proc/x': /proc cannot be written"),
    ],
)
def test_a_calibration_goes_into_a_folder_of_its_own(
    tmp_path: Path, out: str, said: str, cameras: list[str]
) -> None:
    for file in ("lab/board.png", "lab/wrist/00.png", "lab/poses.json", "other/camera_place.png"):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text("not to be lost")
    before = bytes_of(tmp_path)
    words = ["calibrate", tmp_path / "lab", "--board", "tag:7,size=80mm", "--out", tmp_path / out]
    assert said in refused(*words, *cameras)
    assert bytes_of(tmp_path) == before


def test_a_session_without_its_header_is_told_and_how_it_is_mended(
    session: Path, tmp_path: Path
) -> None:
    board = session / "calibration/capture"
    captured_session(board, count=2)
    header = session / "session.json"
    kept = header.read_bytes()
    header.unlink()
    out = tmp_path / "out"
    for words in (
        ["export", session, "--to", "bop", "--out", out], ["stats", session],
        ["export", session.parent, "--to", "bop", "--out", out], ["stats", session.parent],
        ["import", session, out], ["report", session], ["review", session, "--no-browser"],
        ["school", session], ["school", "settle", session], ["school", "summary", session],
        ["calibrate", session], ["depth-fit", session, "--out", tmp_path / "sensor.json"],
        ["demonstrations", session, "--out", out],
    ):  # fmt: skip
        said = refused(*words)
        assert "session.json is lost" in said and "--repair` makes it anew" in said, words
    assert not out.exists()
    header.write_bytes(kept)


def test_overwrite_is_for_what_the_command_wrote(session: Path, tmp_path: Path) -> None:
    plan = "shipped:ur5_d405_hemisphere_256"

    def convert_to(folder: Path) -> object:
        return invoked("plan-convert", plan, folder, "--overwrite", "--quiet").exception

    own, other = tmp_path / "own", tmp_path / "other"
    assert convert_to(own) is None and convert_to(own) is None  # its own files it may replace
    other.mkdir()
    made = (own / "plan.json").read_bytes()
    for name, data in (("camera_poses.npy", b"not to be lost"), ("plan.json", made)):
        (other / name).write_bytes(data)
        assert "is there, made by something else" in str(convert_to(other))
        assert bytes_of(other) == {name: data}
        (other / name).unlink()
    for inside in (session, session / "rgb"):
        assert "part of the session" in str(convert_to(inside))
    (session / "plan.json").write_bytes(made)
    words = ("plan", "--views", "4", "--out", session / "plan.json", "--overwrite")
    assert "part of the session" in refused(*words)
    (session / "plan.json").unlink()


def test_a_document_that_holds_another_commands_is_not_its_own(tmp_path: Path) -> None:
    name, path = "school summary --json-file", tmp_path / "a.json"
    held = {"with_trajectory": 1, "closures": []}
    atomic.write_json(path, held)
    assert convert(name, path) == path
    atomic.write_json(path, {"statistics": {}, "school": held})
    refusals.refused("not replaced", convert, name, path)


def test_a_session_keeps_its_calibration_itself(session: Path, tmp_path: Path) -> None:
    said = refused("calibrate", session, "--out", tmp_path / "elsewhere")
    assert "keeps its calibration itself" in said
