"""Many tasks on a Ray cluster: the same results, a dead node survived, a lost head told."""

import json
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from many_tasks import (
    dies_first,
    doubled,
    fills_the_disk,
    odd_fails,
    rewrites,
    sizes,
    spoils_and_fails,
)
from realsim.errors import InputError
from realsim.many import (
    ForeignNodeError,
    PoolConfig,
    Sent,
    Shared,
    Task,
    Worked,
    WorkerDiedError,
    open_pool,
    run_many,
)
from realsim.many.ray_driver import on_node
from realsim.many.ray_node import work
from realsim.many.ray_pool import _ending
from realsim.store.lock import only_run_in

SUPPORT = Path(__file__).parents[1] / "support"
LONGEST_S = 240


# --- without Ray ----------------------------------------------------------------------------------


def test_what_is_no_address_is_named():
    for address in ("10.0.0.1", "ray://10.0.0.1:10001", ":6379", "head:port"):
        with (
            pytest.raises(InputError, match="no address of a Ray cluster"),
            open_pool(PoolConfig(address=address)),
        ):
            pass


def test_a_cluster_is_not_joined_without_a_token(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_AUTH_MODE"):
        monkeypatch.delenv(name, raising=False)
    config = PoolConfig(address="192.0.2.77:6379")
    with pytest.raises(InputError, match="no token for the Ray cluster"), open_pool(config):
        pass
    monkeypatch.setenv("RAY_AUTH_TOKEN", "t" * 64)
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    with pytest.raises(InputError, match="RAY_AUTH_MODE=token"), open_pool(config):
        pass


def test_without_ray_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    config = PoolConfig(address="local")
    with pytest.raises(InputError, match=r"realsim\[cluster\]"), open_pool(config):
        pass


def test_a_machine_with_another_version_does_nothing_and_is_named():
    (told,) = on_node("0.0.7", "run", (), b"", {})
    assert "realsim" in told and "this one 0.0.7" in told
    error = _ending("foreign", told)
    assert isinstance(error, ForeignNodeError) and "Install the same version" in str(error)


@pytest.mark.parametrize("is_stored", [False, True])
def test_a_machine_whose_disk_is_full_counts_as_lost(is_stored, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    job = pickle.dumps((fills_the_disk, (str(tmp_path), is_stored)))
    (ended,) = work("run", job, lambda digest: b"")
    found = _ending("ended", ended)
    assert isinstance(found, WorkerDiedError) and "the disk of" in str(found)


# --- one machine ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster():
    pytest.importorskip("ray")
    with open_pool(PoolConfig(workers=2, address="local")) as pool:
        yield pool


def ran(pool, *tasks):
    outcomes = {}

    def keep(outcome):
        outcomes[outcome.task.name] = outcome

    named = [Task(name=str(k), fn=fn, args=tuple(args)) for k, (fn, *args) in enumerate(tasks)]
    summary = run_many(named, pool, keep)
    return summary, [outcomes[t.name] for t in named]


@pytest.mark.slow
def test_tasks_on_a_cluster_do_what_they_do_here(cluster, tmp_path):
    summary, found = ran(
        cluster,
        *((doubled, k) for k in range(8)),
        (odd_fails, 3),
        (dies_first, str(tmp_path), 1),
        (doubled, Shared([1, 2])),
    )
    assert [o.value for o in found[:8]] == [2 * k for k in range(8)]
    assert found[8].why == "3 is odd" and isinstance(found[8].error, InputError)
    assert found[9].value == 1 and found[9].deaths == 1
    assert found[10].value == [1, 2, 1, 2] and summary.lost == 1 and summary.done == 10


@pytest.mark.slow
def test_a_task_that_kills_three_workers_is_named(cluster, tmp_path):
    summary, (found,) = ran(cluster, (dies_first, str(tmp_path), 9))
    assert "3 workers ended in the middle of it" in found.why and len(summary.failed) == 1
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.slow
def test_files_travel_and_changes_come_back_or_nothing_does(cluster, tmp_path):
    folder = tmp_path / "worked"
    folder.mkdir()
    for name in ("changed.txt", "log.txt", "gone.txt", "same.txt"):
        (folder / name).write_text("before ")
    untouched = (folder / "same.txt").stat().st_mtime_ns
    summary, found = ran(cluster, (spoils_and_fails, Worked(folder)))
    assert found[0].why == "it cannot be done"
    assert {p.read_text() for p in folder.iterdir()} == {"before "} and len(summary.failed) == 1
    _, found = ran(cluster, (sizes, Sent(folder), Sent(b"1234")), (rewrites, Worked(folder), "x"))
    names = ("changed.txt", "gone.txt", "log.txt", "same.txt")
    assert found[0].value == [dict.fromkeys(names, 7), 4]
    kept = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert kept == {"changed.txt", "log.txt", "same.txt", "empty.txt", "last.txt",
                    "below/large.bin"}  # fmt: skip
    assert (folder / "changed.txt").read_text() == "x"
    assert (folder / "log.txt").read_text() == "before x"
    assert (folder / "below/large.bin").stat().st_size == 20_000_000
    assert (folder / "same.txt").stat().st_mtime_ns == untouched
    with only_run_in(folder):  # nobody else may work in it meanwhile
        assert "another run is working" in ran(cluster, (sizes, Worked(folder)))[1][0].why


# --- several machines, and commands ---------------------------------------------------------------


def program(*arguments):
    # Ray reads its variables when it is imported: it has a process of its own.
    kept = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    done = subprocess.run(
        [sys.executable, SUPPORT / "ray_on_loopback.py", *map(str, arguments)],
        env=kept | {"PYTHONPATH": str(SUPPORT), "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True, text=True, timeout=LONGEST_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    # Ray tells of its nodes on the same way out.
    return json.loads(next(line for line in done.stdout.splitlines() if line.startswith("{")))


@pytest.mark.slow
def test_of_two_nodes_one_is_killed_and_the_result_is_that_of_one_machine(tmp_path):
    pytest.importorskip("ray")
    found = program("node", tmp_path)
    assert 1 <= found["finished_when_lost"] < 4, "the node was killed in the middle"
    assert found["code"] == 0, found["told"]
    assert found["same"] and not found["leftovers"] and not found["beyond_loopback"]


@pytest.mark.slow
def test_a_lost_head_ends_in_a_sentence_and_the_same_command_goes_on(tmp_path):
    pytest.importorskip("ray")
    found = program("head", tmp_path)
    assert 1 <= found["finished_when_lost"] < 4, "the head was killed in the middle"
    assert found["code"] == 2
    told = [line for line in found["told"].splitlines() if line.strip()]
    assert told[-1].startswith("error: the Ray cluster (127.0.0.1:")
    assert "is lost: its head is gone. Until then" in told[-1] and "goes on from here" in told[-1]
    assert not any("ray." in line or "Traceback" in line for line in told), told
    assert found["kept_same"] and found["kept"] and not found["leftovers"]
    assert found["again_code"] == 0 and found["same"]


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_ctrl_c_and_sigterm_end_in_a_sentence(number, code, tmp_path):
    pytest.importorskip("ray")
    sys.path.insert(0, str(SUPPORT))
    import ray_on_loopback as loopback

    process = loopback.generate(tmp_path / "out", "--address", "local", "--workers", "1")
    loopback.wait_for_one(process, tmp_path / "out")
    process.send_signal(number)
    begun = time.monotonic()
    _, told = process.communicate(timeout=LONGEST_S)
    assert process.returncode == code, told
    assert time.monotonic() - begun < 30
    assert told.strip().splitlines()[-1].startswith("interrupted: ")
    assert told.strip().endswith("; the same command goes on from here.")
    assert "Traceback" not in told and not list((tmp_path / "out").rglob("*.part"))
