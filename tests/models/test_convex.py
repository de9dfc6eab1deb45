"""Convex parts: they fill the mesh and not its hollows, in bounded time; and their file."""

import subprocess
import time
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from realsim.geometry.mesh import decimated, hull_vertices, mass_properties
from realsim.geometry.parts import part
from realsim.models import convex
from realsim.models.convex import ConvexConfig, collision_obj, convex_parts
from realsim.models.convex_hulls import fewest, hull_volume, outermost
from realsim.records import Mesh
from refusals import refused
from started_scripts import started
from trimesh_solids import box, solid

QUICK = ConvexConfig(thresholds=(0.1, 0.05), mcts_iterations=10, mcts_depth=1)
RING = solid(trimesh.creation.annulus(0.02, 0.03, 0.03, sections=24))


def inside(parts, points):
    """Whether each point lies in one of the parts."""
    within = np.zeros(len(points), dtype=bool)
    for p in parts:
        eq = ConvexHull(p).equations
        within |= np.all(points @ eq[:, :3].T + eq[:, 3] <= 0, axis=1)
    return within


# --- the parts ----------------------------------------------------------------------------------


def test_a_convex_mesh_is_its_hull():
    whole = convex_parts(box((0.05, 0.05, 0.05)), ConvexConfig())
    assert whole.method == "hull" and len(whole.parts) == 1 and whole.notes == ()
    assert abs(whole.volume_ratio - 1) < 1e-9


def test_a_ring_is_cut_kept_and_found_again_by_every_run_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    ring, folders = RING, (tmp_path / "one", tmp_path / "one", tmp_path / "other")
    cut, *others = (convex_parts(ring, QUICK, folder) for folder in folders)
    assert cut.method == "coacd" and len(cut.parts) > 3 and 0.9 <= cut.volume_ratio <= 1.1
    full = sum(hull_volume(p) for p in cut.parts)
    assert cut.volume_ratio == pytest.approx(full / solid_volume(ring))
    around = 0.025 * np.stack([np.cos(np.arange(12)), np.sin(np.arange(12)), np.zeros(12)], -1)
    assert inside(cut.parts, around).mean() > 0.9 and not inside(cut.parts, np.zeros((1, 3)))[0]
    for again in others:
        assert all(np.array_equal(a, b) for a, b in zip(cut.parts, again.parts, strict=True))
        assert (again.method, again.seconds, again.notes) == (cut.method, cut.seconds, cut.notes)
    assert len(list(tmp_path.rglob("convex_*.npz"))) == 3


def solid_volume(mesh):
    return mass_properties(mesh, 1.0).volume_m3


@pytest.mark.slow
def test_an_open_mesh_is_cut_and_says_so_and_faces_that_look_inwards_make_no_difference():
    cut = convex_parts(replace(RING, faces=RING.faces[1:]), QUICK)
    assert cut.method == "coacd" and "not closed" in cut.notes[0]
    assert not inside(cut.parts, np.zeros((1, 3)))[0]
    flipped = convex_parts(replace(RING, faces=RING.faces[:, ::-1]), QUICK)
    assert flipped.volume_ratio == pytest.approx(1.0, abs=0.1) and flipped.notes == ()


@pytest.mark.slow
def test_a_mug_keeps_its_hollow():
    mug = part("mug").mesh
    cut = convex_parts(mug, ConvexConfig())
    assert cut.method == "coacd" and len(cut.parts) <= ConvexConfig().max_parts
    z = np.linspace(mug.bounds[0, 2] + 0.02, mug.bounds[1, 2] - 0.002, 30)
    t = np.linspace(0, 2 * np.pi, 24)
    hollow = np.array([[0.02 * np.cos(a), 0.02 * np.sin(a), h] for a in t for h in z])
    assert inside(cut.parts, hollow).mean() < 0.01
    assert cut.volume_ratio <= 1.10 and cut.notes == ()


# --- bounded time -------------------------------------------------------------------------------


def test_a_decomposition_out_of_time_gives_the_hull_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    flange, config = part("flange").mesh, ConvexConfig(time_limit_s=1.0)
    cut, again = (convex_parts(flange, config, tmp_path) for _ in range(2))
    assert cut.method == "hull (out of time)" and len(cut.parts) == 1
    assert "1 CPU-s was over" in cut.notes[0] and "no hollow" in cut.notes[1]
    assert cut.volume_ratio > 1.5 and not (tmp_path / "user").exists()
    assert (again.method, again.notes) == (cut.method, cut.notes)


@pytest.mark.slow
def test_what_was_found_in_time_is_taken():
    # At threshold 1 nothing is cut, which takes no time; 0.02 takes a flange 20 CPU-s and more.
    cut = convex_parts(part("flange").mesh, ConvexConfig(thresholds=(1.0, 0.02), time_limit_s=4.0))
    assert cut.method == "coacd" and "stopped" in cut.notes[0] and "at best" in cut.notes[1]
    assert "(threshold 1)" in cut.notes[1] and cut.volume_ratio > 1.5


SCRIPT = """
from realsim.geometry.parts import part
from realsim.models.convex import ConvexConfig, convex_parts
print("begun", flush=True)
convex_parts(part("flange").mesh, ConvexConfig(thresholds=(0.02,), mcts_iterations=150))
"""


def running():
    """Return the processes that run, each with its parent's number."""
    listed = subprocess.run(["ps", "-eo", "pid=,ppid=,stat="], capture_output=True, text=True)
    rows = [line.split() for line in listed.stdout.splitlines()]
    return {int(pid): int(parent) for pid, parent, state in rows if not state.startswith("Z")}


def waited_for(found, seconds):
    """Return what `found()` finds, asked again until that is something or the time is over."""
    end = time.monotonic() + seconds
    while not (result := found()) and time.monotonic() < end:
        time.sleep(0.1)
    return result


@pytest.mark.slow
def test_no_process_is_left_behind_by_a_kill(tmp_path):
    # A script without `if __name__ == "__main__"`, as a user writes it.
    process = started(tmp_path, SCRIPT)
    try:
        workers = waited_for(lambda: {p for p, of in running().items() if of == process.pid}, 120)
        assert workers
        time.sleep(1.0)
        process.kill()
        process.wait(60)
        assert waited_for(lambda: workers.isdisjoint(running()), 60)
    finally:
        process.kill()
        process.wait()


def test_a_thinned_mesh_is_closed_and_as_large():
    mug = part("mug").mesh
    thin = decimated(mug, 3000)
    assert len(thin.faces) <= 3000
    assert solid_volume(thin) == pytest.approx(solid_volume(mug), rel=0.02)
    assert decimated(thin, 10**6) is thin


def test_a_round_part_keeps_its_volume_with_more_corners():
    capsule = part("capsule").mesh
    cut = convex_parts(capsule, ConvexConfig())
    assert cut.method == "hull" and abs(cut.volume_ratio - 1) <= 0.03
    assert 64 < len(cut.parts[0]) <= 256
    coarse = convex_parts(capsule, ConvexConfig(most_vertices=64))
    assert len(coarse.parts[0]) <= 64 and coarse.volume_ratio < 0.95
    # What 64 corners describe well enough gets no more.
    corners = hull_vertices(0.05 * np.random.default_rng(0).normal(size=(90, 3)))
    assert np.array_equal(fewest(corners, 64, 256, 0.03), outermost(corners, 64))


def test_settings_that_bound_nothing_are_refused():
    for wrong in ({"time_limit_s": 0.0}, {"thresholds": ()}, {"thresholds": (2.0,)},
                  {"max_parts": 0}, {"max_vertices": 300}, {"vertex_loss": 1.0}):  # fmt: skip
        refused(".", ConvexConfig, **wrong)
    refused("flat", convex_parts, Mesh(vertices=np.eye(3), faces=np.array([[0, 1, 2]])), QUICK)


# --- the file -----------------------------------------------------------------------------------


def some_parts():
    rng = np.random.default_rng(2)
    return tuple(hull_vertices(0.02 * rng.normal(size=(20, 3)) + [0.1 * k, 0, 0]) for k in range(4))


def test_the_obj_gives_the_same_corners_back_bit_for_bit():
    parts = some_parts()
    back = convex.parts_from_collision_obj(collision_obj(parts))
    assert len(back) == len(parts)
    for a, b in zip(parts, back, strict=True):
        assert np.array_equal(a[np.lexsort(a.T)], b[np.lexsort(b.T)])
    assert collision_obj(back) == collision_obj(parts)


def test_bad_parts_and_other_files_are_refused():
    refused("no convex parts", collision_obj, ())
    refused(r"part 1 of 2 .* is flat", collision_obj, (some_parts()[0], np.eye(3)))
    for text in (b"", b"o part_000\n", b"v 0 0 0\n", b"o part_000\nv 0 x 0\n", b"\xff\xfe"):
        refused("collision OBJ", convex.parts_from_collision_obj, text)
