"""Laws of a folder that an export fills: whole or not at all, gone on with to the same bytes.

Law of exports: the memory of a writer does not grow with what it has written.

An export in a process of its own is looked at when few frames are written and when all are, and
closed: what it needs more, a frame, is far less than what a frame is. So 100,000 frames fit in the
memory that a few hundred need, and a frame that is kept, or its rows, or its masks, shows.
"""

import hashlib
import json
import shutil
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from bounded_memory import alone, own_kb
from file_trees import bytes_of
from labelled_scenes import SceneInMemory
from realsim import CameraIntrinsics, images
from realsim.formats.bop.root_files import write_bop_root
from realsim.formats.bop.writing import write_bop_scene
from realsim.formats.export_folder import FINISHED, STATE, SUMS_FILE, ExportFolder
from realsim.formats.labelled_scene import LabelledFrame, LabelledObject
from realsim.geometry import se3
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
    told = r"another request \(scenes: \[1, 2\] there, \[3\]"
    refused(told, ExportFolder.begin, tmp_path, {**ASKED, "scenes": [3]})
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


FEW = 300
MOST_KB = 4.0
"""[kB] a frame: 100,000 frames grow by less than half of a gigabyte. Names of pieces, poses of
cameras and what closing needs are 0.9 to 2.4; the rows of a frame as Python has them are 7, its two
masks 20."""

CAMERA = CameraIntrinsics(width=128, height=80, fx=90.0, fy=90.0, cx=64.0, cy=40.0)


class Long(SceneInMemory):
    """A scene of many frames, none of which is kept."""

    @property
    def indices(self):
        return range(self.count)

    @lru_cache(maxsize=1)  # noqa: B019 - there is one scene in the process
    def frame(self, index):
        T_world_cam = se3.from_rt(se3.exp_so3([np.pi, 0, 1e-3 * np.sin(index)]), [0, 0, 0.7])
        thing = LabelledObject(obj_id=1, instance=0, T_cam_obj=se3.invert(T_world_cam))
        return LabelledFrame(
            index=index, intrinsics=CAMERA, depth_unit_m=1e-3, objects=(thing,),
            T_world_cam=T_world_cam,
        )  # fmt: skip

    def colour_file(self, index):
        return self.folder / "colour.png"

    def depth_file(self, index):
        return self.folder / "depth.png"

    def mask(self, index, k, *, visible):
        mask = np.zeros((80, 128), bool)
        mask[30:50, 50:78] = True
        return mask


def written(home, name, frames, few=0):
    """Write a scene of so many frames; return the peak of memory after few of them [kB]."""
    peaks = []
    export = ExportFolder.begin(home / name, {})
    scene = Long(folder=home, frames={}, masks={}, models_by_id={}, T_world_table=np.eye(4))
    scene.count = frames
    write_bop_scene(
        scene, export, progress=lambda: peaks.append(own_kb("VmHWM") if len(peaks) < few else 0)
    )
    write_bop_root(export, name="long")
    export.finish({})
    return max(peaks)


def measured(home, frames=1000):
    (home / "colour.png").write_bytes(images.png_bytes(np.full((80, 128, 3), 90, np.uint8)))
    (home / "depth.png").write_bytes(images.png_bytes(np.full((80, 128), 700, np.uint16)))
    written(home, "first", 20)  # what is imported on the way, and buffers that stay
    Path("/proc/self/clear_refs").write_text("5")
    level = own_kb("VmRSS")
    with_few, peak = written(home, "long", frames, FEW), own_kb("VmHWM")
    assert (peak - with_few) / (frames - FEW) < MOST_KB
    assert peak - level < 60_000


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="peaks are read from /proc")
@pytest.mark.slow
def test_a_frame_more_needs_no_more_memory(tmp_path):
    alone(measured, tmp_path)
