"""Robot School on a Ray cluster that loses a worker: it finds what one process finds."""

import os
import signal
import subprocess
import threading

import pytest

from realsim.many import PoolConfig
from realsim_sim_bridge.school import run_school_results
from school_scenes import at, model, same_result, scene, small_worlds


def ray_workers_below(pid):
    """Return the processes that Ray calls workers, below a process."""
    listed = subprocess.run(
        ["ps", "-eo", "pid=,ppid=,args="], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    rows = [line.split(None, 2) for line in listed]
    below = {pid}
    for _ in range(6):
        below |= {int(row[0]) for row in rows if int(row[1]) in below}
    return [int(r[0]) for r in rows if int(r[0]) in below and r[2].startswith("ray::on_node")]


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_finds_what_one_process_finds():
    pytest.importorskip("ray")
    objects = scene(at(0, 0), at(0.2, 0.1, instance=1))
    killed = []

    def kill_one(done, of):
        def kill():
            for pid in ray_workers_below(os.getpid())[:1]:
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

        if not killed and 4 <= done < of:
            threading.Timer(0.05, kill).start()

    where = PoolConfig(workers=2, address="local")
    settings = {"shard_grasps": 2}
    found = run_school_results(
        objects, {1: model()}, small_worlds(), workers=where, progress=kill_one, **settings
    )
    alone = run_school_results(objects, {1: model()}, small_worlds(), workers=1, **settings)
    assert killed, "a worker was killed in the middle"
    for a, b in zip(found, alone, strict=True):
        assert not a.unfinished and same_result(a, b)
