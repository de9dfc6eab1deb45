"""Robot School interrupted, killed, and started again with something else."""

import os
import signal
import subprocess
import threading
import time
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from file_trees import bytes_of
from realsim.errors import InputError
from realsim.many import PoolConfig, WorkerDiedError, open_pool
from realsim_sim_bridge.school import recompute_scores, run_school, run_school_results, school
from realsim_sim_bridge.school.cache_folder import RUN_FILE, folder_of_run
from realsim_sim_bridge.school.shards import in_words
from refusals import refused
from school_scenes import at, model, scene, small_worlds
from started_scripts import started
from tried_grasps import assert_same

CONFIG = small_worlds()
SHARD = 2
TWO = scene(at(0, 0), at(0.2, 0.1, instance=1))


def run(cache=None, config=CONFIG, objects=None, models=None, **kwargs):
    kwargs = {"workers": 1, "shard_grasps": SHARD} | kwargs
    objects = objects or scene(at(0, 0))
    return run_school_results(objects, models or {1: model()}, config, cache=cache, **kwargs)


@pytest.fixture(scope="module")
def whole():
    """The result of an uninterrupted run."""
    return run()[0]


def names(folder, what):
    return sorted(p.name for p in folder.glob(f"instance_*.{what}*.npz"))


# --- interrupted --------------------------------------------------------------------------------


def test_ctrl_c_says_how_to_go_on_and_the_next_run_does_no_shard_again(tmp_path, whole):
    judged = 2

    def stop(done, expected):
        if done >= judged + np.sum(~whole.grasp_set.reachable):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"of 6 grasps; they are kept in .* goes on"):
        run(tmp_path, progress=stop)
    kept = names(tmp_path, "shard")
    before = {name: (tmp_path / name).stat().st_mtime_ns for name in kept}
    assert len(kept) == judged // SHARD and names(tmp_path, "prepared")
    seen = []

    def look(done, _):
        seen.append(done)
        for name in names(tmp_path, "shard"):
            assert before.get(name, 0) in (0, (tmp_path / name).stat().st_mtime_ns)

    result = run(tmp_path, progress=look)[0]
    assert seen[0] >= judged
    assert_same(result, whole)
    assert names(tmp_path, "") == ["instance_000000.grasps.npz"]


def test_a_damaged_piece_is_made_again(tmp_path, whole):
    def stop(done, _):
        if done >= 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, progress=stop)
    for path in tmp_path.glob("instance_*.npz"):
        path.write_bytes(path.read_bytes()[:100])
    assert_same(run(tmp_path)[0], whole)


SCRIPT = """
import sys
from pathlib import Path
from school_scenes import at, model, scene, small_worlds
from realsim_sim_bridge.school import run_school

if __name__ == "__main__":
    run_school(
        scene(at(0, 0), at(0.2, 0.1, instance=1)), {1: model()}, small_worlds(),
        workers=2, cache=Path(sys.argv[1]), shard_grasps=2,
        progress=lambda done, of: print(done, of, flush=True),
    )
"""


@pytest.mark.slow
def test_a_run_killed_at_random_moments_ends_as_if_it_had_not_been(tmp_path):
    rng = np.random.default_rng(2)
    judged = 0
    for _ in range(2):
        process = started(tmp_path, SCRIPT, tmp_path / "cache")
        lines = [process.stdout.readline() for _ in range(rng.integers(1, 4))]
        if lines[0]:  # what was judged before a kill needs no second test
            assert int(lines[0].split()[0]) >= judged
        time.sleep(rng.uniform(0.0, 0.4))
        process.kill()
        lines += process.stdout.read().split("\n")
        judged = max([judged, *(int(line.split()[0]) for line in lines if line)])
        process.wait()
    process = started(tmp_path, SCRIPT, tmp_path / "cache")
    lines = process.communicate(timeout=120)[0].splitlines()
    assert process.returncode == 0 and lines[-1] == "12 12"
    assert int(lines[0].split()[0]) >= judged > 0
    kept = run(tmp_path / "cache", objects=TWO)
    for a, b in zip(kept, run(objects=TWO), strict=True):
        assert_same(a, b)
    assert not list((tmp_path / "cache").glob(".*"))


# --- dead workers -------------------------------------------------------------------------------


class Deadly:
    """Workers that die of every shard with a certain grasp in it."""

    shares_files = True

    def __init__(self, workers, row, error=None):
        self._workers, self._row, self._error = workers, row, error
        self.deaths = 0

    def capacity(self):
        return 3

    def submit(self, fn, /, *args):
        if len(args) == 3 and self._row in args[1]:
            self.deaths += 1
            future = Future()
            future.set_exception(self._error or WorkerDiedError("its process was killed"))
            return future
        return self._workers.submit(fn, *args)


@pytest.fixture
def deadly(monkeypatch, whole):
    """Workers that die of the object's second shard."""
    shard = np.flatnonzero(whole.grasp_set.reachable)[SHARD : 2 * SHARD]
    made = []

    def hire(error=None):
        @contextmanager
        def staff(_):
            with open_pool(1) as workers:
                made.append(Deadly(workers, shard[0], error))
                yield made[-1]

        monkeypatch.setattr(school, "open_pool", staff)
        return shard, made

    return hire


def test_a_shard_that_kills_its_workers_is_given_up_with_its_grasps_named(
    tmp_path, whole, deadly, monkeypatch
):
    with monkeypatch.context():
        shard, made = deadly()
        result = run(tmp_path)[0]
    assert made[0].deaths == 3
    found = result.grasp_set
    assert result.unfinished == (f"{in_words(shard)}: {found.failures[shard[0]][12:]}",)
    assert "3 workers ended in the middle of it" in found.failures[shard[0]]
    assert np.isnan(found.scores[shard]).all() and np.isnan(recompute_scores(found)[1][shard]).all()
    others = np.setdiff1d(np.arange(6), shard)
    assert np.array_equal(found.scores[others], whole.grasp_set.scores[others])
    monkeypatch.undo()
    assert_same(run(tmp_path)[0], whole)


def test_an_error_in_a_shard_names_object_and_grasps(deadly):
    shard, _ = deadly(InputError("the mesh is odd"))
    refused(rf"'box1' \(instance 0\), {in_words(shard)}: the mesh", run)
    deadly(ZeroDivisionError("x"))
    with pytest.raises(ZeroDivisionError) as caught:
        run()
    assert any(in_words(shard) in note for note in caught.value.__notes__)


# --- something else in the same folder ------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    run(folder)
    return folder


def test_another_config_is_refused_field_by_field(finished):
    physics = replace(CONFIG.slip.physics, friction=0.5, force_n=20.0)
    other = replace(CONFIG, seed=4, slip=replace(CONFIG.slip, physics=physics))
    before = bytes_of(finished, "*")
    said = refused(".", run, finished, other)
    assert [line.strip() for line in said.splitlines()[1:-1]] == [
        "config.seed: 0 -> 4",
        "config.slip.physics.force_n: 70.0 -> 20.0",
        "config.slip.physics.friction: 1.0 -> 0.5",
    ]
    assert "--restart" in said and "another folder" in said
    assert before == bytes_of(finished, "*")


def test_another_mesh_pose_or_object_is_refused(finished):
    for change, field in (
        ({"models": {1: model(size=0.04)}}, "objects.instance_000000.mesh"),
        ({"models": {1: model(density=500.0)}}, "objects.instance_000000.density"),
        ({"objects": scene(at(0.1, 0))}, "objects.instance_000000.T_table_obj.0.3"),
        ({"objects": scene(at(0, 0), at(0.2, 0, 1))}, "objects.instance_000001: (nothing) ->"),
        ({"shard_grasps": 4}, "shard_grasps: 2 -> 4"),
    ):
        assert field in refused("started with something else", run, finished, **change)


def test_another_version_is_refused(finished, monkeypatch):
    from realsim.store import provenance

    real = provenance.versions_of
    monkeypatch.setattr(provenance, "versions_of", lambda names: real(names) | {"pybullet": "9.9"})
    refused(r"versions.pybullet: \"[\d.]+\" -> \"9.9\"", run, finished)


def test_results_of_unknown_origin_are_refused(tmp_path):
    (tmp_path / "instance_000000.grasps.npz").write_bytes(b"")
    refused(f"no {RUN_FILE}", run, tmp_path)
    (tmp_path / RUN_FILE).write_text("{")
    refused("damaged", run, tmp_path)


def test_two_runs_at_once_in_one_folder_are_refused(tmp_path):
    with folder_of_run(tmp_path, {}, restart=False), pytest.raises(InputError, match="another run"):
        run_school(scene(at(0, 0)), {1: model()}, CONFIG, workers=1, cache=tmp_path)


def test_only_a_finished_run_gives_way_to_another(tmp_path, whole):
    other = replace(CONFIG, seed=7)
    run(tmp_path, other)
    assert_same(run(tmp_path, restart="finished")[0], whole)
    grasps = names(tmp_path, "grasps")
    written = [(tmp_path / name).stat().st_mtime_ns for name in grasps]
    for again in ("finished", True):  # of this very run nothing is thrown away
        run(tmp_path, restart=again)
        assert written == [(tmp_path / name).stat().st_mtime_ns for name in grasps]
    (tmp_path / "finished").unlink()
    refused("seed: ", run, tmp_path, other, restart="finished")


# --- Robot School on a Ray cluster that loses a worker: it finds what one process finds.


def ray_workers_below(pid):
    """Return the processes that Ray calls workers, below a process."""
    listed = subprocess.check_output(["ps", "-eo", "pid=,ppid=,args="], text=True)
    rows = [line.split(None, 2) for line in listed.splitlines()]
    below = {pid}
    for _ in range(6):
        below |= {int(row[0]) for row in rows if int(row[1]) in below}
    return [int(r[0]) for r in rows if int(r[0]) in below and r[2].startswith("ray::on_node")]


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_finds_what_one_process_finds():
    killed = []

    def kill_one(done, of):
        def kill():
            for pid in ray_workers_below(os.getpid())[:1]:
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

        if not killed and 4 <= done < of:
            threading.Timer(0.05, kill).start()

    where = PoolConfig(workers=2, address="local")
    found = run(objects=TWO, workers=where, progress=kill_one)
    assert killed, "a worker was killed in the middle"
    for a, b in zip(found, run(objects=TWO), strict=True):
        assert not a.unfinished
        assert_same(a, b)
