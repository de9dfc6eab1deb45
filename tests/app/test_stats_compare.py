"""Two releases of a data set: what differs is told, and what is the same is not."""

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from labelled_scenes import SceneInMemory, labelled_scene
from realsim.app.cli import commands
from realsim.app.stats.compare import diff_scenes
from realsim.formats.bop.root_files import write_bop_models
from realsim.formats.bop.writing import write_bop_scene
from realsim.formats.export_folder import ExportFolder
from realsim.formats.grasps.scene_grasps import SceneGrasps
from realsim.geometry import se3
from tried_grasps import tried_set

MOVE = se3.from_rt(se3.exp_so3([0.0, 0.0, np.radians(0.5)]), [0.002, 0.0, 0.0])


class WithGrasps(SceneInMemory):
    def grasps(self):
        return self.tried


def moved(frame):
    first, *others = frame.objects
    return (replace(first, T_cam_obj=first.T_cam_obj @ MOVE), *others)


def written(folder, *scenes):
    export = ExportFolder.begin(folder, {})
    for scene in scenes:
        write_bop_scene(scene, export)
        write_bop_models(scene.models(), export)
    export.finish({})
    return folder


@pytest.fixture(scope="module")
def releases(tmp_path_factory):
    home = tmp_path_factory.mktemp("releases")
    old = labelled_scene(home / "a", [0, 1, 2])
    new = labelled_scene(home / "b", [0, 1, 2])
    new.change_frames(objects=lambda f: moved(f) if f.index == 1 else f.objects)
    del new.frames[2]
    more = labelled_scene(home / "c", [0])
    more.number, more.name = 9, "train-000009"
    return written(home / "old", old), written(home / "new", new, more)


def compared(new, old, *options):
    words = [str(w) for w in ("stats", new, "--compare", old, "--json", *options)]
    result = CliRunner().invoke(commands, words, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)["comparison"]


def test_scenes_frames_objects_and_motions_are_told(releases):
    old, new = releases
    kept, added = compared(new, old)
    assert (kept["scene"], kept["state"]) == ("000003", "kept")
    assert (added["scene"], added["state"]) == ("000009", "added")
    assert (kept["frames"], kept["frames_added"], kept["frames_lost"]) == (2, 0, 1)
    (motion,) = kept["moved"]
    assert motion["obj_id"] == 1
    assert motion["mm"] == pytest.approx(2.0, abs=1e-6)
    assert motion["deg"] == pytest.approx(0.5, abs=1e-6)
    assert [row["state"] for row in compared(old, new)] == ["kept", "lost"]


def test_a_release_is_the_same_as_itself(releases):
    for row in compared(releases[0], releases[0]):
        assert row["frames"] == 3 and row["state"] == "kept"
        assert not (row["moved"] or row["objects_added"] or row["objects_lost"])
        assert not (row["frames_added"] or row["frames_lost"])


def test_grasps_are_added_lost_and_changed(tmp_path):
    plain = labelled_scene(tmp_path / "s", [0])
    whole = tried_set(np.random.default_rng(3), 12, obj_id=7, instance=1, measures=())
    whole = replace(whole, scores=np.full(12, 0.5))
    scores = np.full(12, 0.5)
    scores[3] = 0.8

    def scene(rows, values):
        of = WithGrasps(folder=plain.folder, frames=plain.frames, masks=plain.masks)
        s = replace(whole, scores=values)
        picked = {
            name: getattr(s, name)[rows]
            for name in ("Ts_obj_grasp", "widths_m", "scores", "base_scores", "slip_m", "slip_rad",
                         "reachable")
        }  # fmt: skip
        s = replace(s, **picked, failures=tuple(s.failures[k] for k in rows))
        of.tried = SceneGrasps(sets=(s,))
        return of

    found = diff_scenes("s", scene(np.arange(10), whole.scores), scene(np.arange(2, 12), scores))
    assert (found.grasps_lost, found.grasps_added) == (2, 2)
    assert (found.grasps_changed, found.grasps_kept) == (1, 7)
    assert not found.is_same
