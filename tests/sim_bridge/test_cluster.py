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


def program(*arguments):
    # Ray reads its variables when it is imported: every test has processes of its own.
    kept = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    return subprocess.Popen(
        [sys.executable, PROGRAM, *arguments],
        env=kept | {"PYTHONPATH": str(SUPPORT), "OPENBLAS_NUM_THREADS": "1"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def outcome(*arguments):
    process = program(*arguments)
    out, err = process.communicate(timeout=LONGEST_S)
    assert process.returncode == 0, err[-2000:]
    # Ray tells of its nodes on the same way out.
    return json.loads(next(line for line in out.splitlines() if line.startswith("{")))


@pytest.mark.slow
def test_two_nodes_of_which_one_is_killed_give_what_one_process_gives():
    pytest.importorskip("ray")
    found = outcome("two-nodes")
    assert found["killed"], "the node was killed before the last shard"
    assert found["same"] and found["unfinished"] == [[], []]
    assert not found["beyond_loopback"]


@pytest.mark.slow
def test_a_cluster_that_is_started_stays_on_loopback_and_has_a_token():
    pytest.importorskip("ray")
    found = outcome("started")
    assert found["address"].startswith("127.0.0.1:") and found["mode"] == "token"
    assert found["same"] and not found["beyond_loopback"]
    assert found["left_in_environment"] == []


@pytest.mark.slow
def test_a_cluster_without_a_token_and_one_that_is_not_there_are_refused():
    pytest.importorskip("ray")
    node = program("open")
    try:
        address = json.loads(node.stdout.readline())["address"]
        assert "lets in anyone without a token" in outcome("join", address)["error"]
    finally:
        node.communicate(timeout=60)
    error = outcome("join", address)["error"]
    assert "cannot be joined" in error and f"ray start --address={address}" in error


@pytest.mark.parametrize(
    "address", ["10.0.0.1", "ray://10.0.0.1:10001", "http://head:6379", ":6379", "head:port"]
)
def test_what_is_no_address_is_named(address):
    with pytest.raises(InputError, match="no address of a Ray cluster"):
        run_school(scene(at(0, 0)), {1: model()}, CONFIG, workers=ClusterConfig(address=address))


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
