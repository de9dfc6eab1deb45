"""Robot School on a Ray cluster: the same results, a dead node survived, nobody let in."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from realsim.errors import InputError
from realsim_sim_bridge.school import ClusterConfig, run_school
from realsim_sim_bridge.school.cluster import ray_workers
from school_scenes import CONFIG, at, model, scene

SUPPORT = Path(__file__).parents[1] / "support"
PROGRAM = SUPPORT / "ray_on_loopback.py"
LONGEST_S = 240


def outcome():
    # Ray reads its variables when it is imported: it has a process of its own.
    kept = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    done = subprocess.run(
        [sys.executable, PROGRAM],
        env=kept | {"PYTHONPATH": str(SUPPORT), "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True, text=True, timeout=LONGEST_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    # Ray tells of its nodes on the same way out.
    return json.loads(next(line for line in done.stdout.splitlines() if line.startswith("{")))


@pytest.mark.slow
def test_two_nodes_of_which_one_is_killed_give_what_one_process_gives():
    pytest.importorskip("ray")
    found = outcome()
    assert found["killed"], "the node was killed before the last shard"
    assert found["same"] and found["unfinished"] == [[], []]
    assert not found["beyond_loopback"]


def test_what_is_no_address_is_named():
    for address in ("10.0.0.1", "ray://10.0.0.1:10001", ":6379", "head:port"):
        cluster = ClusterConfig(address=address)
        with pytest.raises(InputError, match="no address of a Ray cluster"):
            run_school(scene(at(0, 0)), {1: model()}, CONFIG, workers=cluster)


def test_a_cluster_is_not_joined_without_a_token(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_AUTH_MODE"):
        monkeypatch.delenv(name, raising=False)
    config = ClusterConfig(address="192.0.2.77:6379")
    with pytest.raises(InputError, match="no token for the Ray cluster"), ray_workers(config):
        pass
    monkeypatch.setenv("RAY_AUTH_TOKEN", "t" * 64)
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    with pytest.raises(InputError, match="RAY_AUTH_MODE=token"), ray_workers(config):
        pass


def test_without_ray_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    before = dict(os.environ)
    with pytest.raises(InputError, match=r"realsim\[cluster\]"), ray_workers(ClusterConfig()):
        pass
    assert dict(os.environ) == before
