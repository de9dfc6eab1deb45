"""Laws of a folder that an export fills: whole or not at all, gone on with to the same bytes."""

import hashlib
import json
import shutil

import pytest

from file_trees import bytes_of
from realsim.errors import InputError
from realsim.formats.export_folder import FINISHED, STATE, SUMS_FILE, ExportFolder
from refusals import refused

ASKED = {"target": "bop", "scenes": [1, 2]}
PIECES = 12


def fill(folder, stop_after=None):
    """Write the pieces of a small export; stop as if killed after some of them."""
    export = ExportFolder.begin(folder, ASKED)
    for k in range(PIECES):
        if k == stop_after:
            return None
        rows = {"scene/all.json": (str(k), {"number": k, "text": "ü" * k})}
        export.write_piece(f"frame {k}", {f"scene/{k:03d}.bin": bytes([k]) * 50 * k}, rows)
    export.write_json_object("scene/all.json")
    export.finish({"README.md": b"what this is\n"})
    return export


@pytest.mark.parametrize(("stop_after", "torn_row"), [
    (1, ""), (PIECES - 1, ""),
    (5, '["frame 5", "5", {"num'),  # it is not glued to the next one
])  # fmt: skip
def test_an_interrupted_export_ends_with_the_bytes_of_a_whole_one(tmp_path, stop_after, torn_row):
    fill(tmp_path / "whole")
    fill(tmp_path / "torn", stop_after=stop_after)
    with (tmp_path / "torn" / STATE / "rows/scene/all.jsonl").open("a") as file:
        file.write(torn_row)
    fill(tmp_path / "torn")
    assert bytes_of(tmp_path / "torn") == bytes_of(tmp_path / "whole")


def test_a_kill_while_the_notes_are_taken_away_leaves_a_finished_export(tmp_path, monkeypatch):
    def killed(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "rmtree", killed)
    with pytest.raises(KeyboardInterrupt):
        fill(tmp_path)
    assert ExportFolder.is_finished(tmp_path, ASKED)


def test_a_kill_before_the_request_is_noted_leaves_a_folder_to_begin_in(tmp_path):
    (tmp_path / "torn" / STATE).mkdir(parents=True)
    fill(tmp_path / "whole")
    fill(tmp_path / "torn")
    assert bytes_of(tmp_path / "torn") == bytes_of(tmp_path / "whole")


def test_the_sums_are_those_of_the_files_and_of_all_files(tmp_path):
    fill(tmp_path)
    found = bytes_of(tmp_path)
    listed = dict(reversed(line.split("  ", 1)) for line in found[SUMS_FILE].decode().splitlines())
    assert listed == {
        name: hashlib.sha256(data).hexdigest()
        for name, data in found.items()
        if name not in (SUMS_FILE, FINISHED)
    }
    assert not (tmp_path / STATE).exists()
    assert json.loads(found["scene/all.json"])["3"] == {"number": 3, "text": "üüü"}


def test_another_request_is_not_mixed_in(tmp_path):
    fill(tmp_path, stop_after=3)
    with pytest.raises(InputError, match=r"another request \(scenes: \[1, 2\] there, \[3\]"):
        ExportFolder.begin(tmp_path, {**ASKED, "scenes": [3]})
    fill(tmp_path)
    refused("holds a finished export", ExportFolder.begin, tmp_path, ASKED)
    refused("is a file", ExportFolder.begin, tmp_path / "README.md", ASKED)


@pytest.mark.parametrize("path", ["../out", "/etc/passwd", "a/../../b", ""])
def test_no_path_leads_out(tmp_path, path):
    export = ExportFolder.begin(tmp_path / "export", ASKED)
    refused("not a path inside", export.write_piece, "one", {path: b"x"})
    refused("not a path inside", export.below("scene").write_piece, "one", {}, {path: ("k", 1)})
    assert not (tmp_path / "out").exists()


def test_a_refusal_leaves_nothing_of_a_new_export_and_all_of_an_old_one(tmp_path):
    begun = ExportFolder.begin(tmp_path / "export", ASKED)
    begun.write_piece("one", {"a/b/1": b"x"}, {"a/all.json": ("1", 1)})
    begun.abandon()
    assert not (tmp_path / "export").exists()
    ExportFolder.begin(tmp_path / "export", ASKED).write_piece("one", {"1": b"x"})
    ExportFolder.begin(tmp_path / "export", ASKED).abandon()
    assert ExportFolder.begin(tmp_path / "export", ASKED).has("one")
