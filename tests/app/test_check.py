"""`realsim check`: exit codes, the table, JSON, and the repair, also beside a running capture."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

from begun_sessions import begun
from realsim.records import CameraIntrinsics, View
from realsim.store import SessionStore
from realsim.store.lock import only_run_in
from typed_commands import invoked, realsim

CAMERA = CameraIntrinsics(width=40, height=30, fx=40, fy=40, cx=19.5, cy=14.5)


@pytest.fixture
def session(tmp_path: Path) -> Path:
    folder = tmp_path / "table"
    for place, views in ((folder, 4), (folder / "calibration/capture", 2)):
        store = begun(place, CAMERA)
        store.write_json("plan.json", {"content": {"joints": [[0.0] * 6] * 5}})
        for index in range(views):
            rgb = np.random.default_rng(index).integers(0, 256, (30, 40, 3), dtype=np.uint8)
            store.add_view(View(index=index), rgb, np.full((30, 40), 0.3, np.float32))
    return folder


def run(*arguments: str | Path) -> Result:
    return invoked("check", *arguments)


def test_a_sound_session_ends_with_0(session: Path) -> None:
    result = run(session)
    assert result.exit_code == 0, result.output
    assert "4 of 5 planned" in result.output and "sound: every listed file" in result.output
    told = json.loads(run(session, "--json").output)
    assert told["sound"] and told["views_not_captured"] == [4]
    assert [r["views"] for r in told["inner"]] == [2]


def test_damage_ends_with_1_and_a_repair_takes_it_out(session: Path) -> None:
    path = session / "calibration/capture/depth/000001.png"
    path.write_bytes(path.read_bytes()[:-20])
    (session / "rgb/000002.png").unlink()
    result = run(session)
    assert result.exit_code == 1
    assert "rgb/000002.png" in result.output and "depth/000001.png" in result.output
    assert "--repair" in result.output
    told = json.loads(run(session, "--json").output)
    assert told["views_damaged"] == [2] and told["inner"][0]["views_damaged"] == [1]
    repaired = run(session, "--repair")
    assert repaired.exit_code == 0, repaired.output
    assert "views 2 count as not captured" in repaired.output
    assert "damaged/depth/000002.png" in repaired.output
    assert run(session).exit_code == 0
    again = json.loads(run(session, "--repair", "--json").output)
    assert again["moved"] == [] and again["dropped_views"] == []
    assert SessionStore.open(session).completed == {0, 1, 3}
    assert run(session, "--decode").exit_code == 0


def test_what_is_no_session_ends_with_2(session: Path) -> None:
    for folder, told in (
        (session / "rgb", "is not a session"),
        (session.parent, "Did you mean"),
        (session / "nowhere", "is not a session"),
    ):
        done = realsim("check", folder)
        assert done.returncode == 2 and told in done.stderr


def test_files_without_a_checksum_are_named_and_those_of_others_explained(session: Path) -> None:
    (session / "models").mkdir()
    (session / "models/obj_000001.ply").write_text("ply")
    path = session / "manifest.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in lines if "rgb/000001" not in line))
    result = run(session)
    assert result.exit_code == 0
    assert "1: rgb/000001.png" in result.output and "models/ 1 (no checksum" in result.output
    assert "1 files of the session have no checksum" in result.output
    told = json.loads(run(session, "--json").output)
    assert told["files_without_checksum"] == ["rgb/000001.png"]
    assert told["files_beside"] == {"models/": 1}
    assert {f["path"]: f["kind"] for f in told["findings"]} == {"rgb/000001.png": "unproven"}
    repaired = run(session, "--repair")
    assert repaired.exit_code == 0 and "rgb/000001.png" in repaired.output
    assert "nothing can tell" in repaired.output
    assert json.loads(run(session, "--json").output)["files_without_checksum"] == []


def test_a_running_capture_is_not_repaired(session: Path) -> None:
    with only_run_in(session):
        done = realsim("check", session, "--repair")
        assert done.returncode == 2 and "another run is working" in done.stderr
        assert run(session).exit_code == 0
