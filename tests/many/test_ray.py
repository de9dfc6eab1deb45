"""Many tasks on a Ray cluster: the same results, a dead node survived, a lost head told."""

import os
import pickle
import signal
import subprocess
import sys

import pytest

import many_tasks
import ray_on_loopback
from realsim import many
from realsim.errors import InputError
from realsim.many.ray_driver import on_node
from realsim.many.ray_node import work
from realsim.many.ray_pool import _ending
from realsim.store.atomic import only_run_in
from refusals import refused

# --- without Ray ----------------------------------------------------------------------------------


def opened(address):
    """Open a cluster, and leave it at once."""
    with many.open_pool(many.PoolConfig(address=address)):
        pass


def test_what_is_no_address_is_named():
    for address in ("10.0.0.1", "ray://10.0.0.1:10001", ":6379", "head:port"):
        refused("no address of a Ray cluster", opened, address)
    refused(r"no machine of the name 'nowhere\.invalid' is known", opened, "nowhere.invalid:6379")


def test_a_cluster_is_not_joined_without_a_token(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_AUTH_MODE"):
        monkeypatch.delenv(name, raising=False)
    refused("no token for the Ray cluster", opened, "192.0.2.77:6379")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "t" * 64)
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    refused("RAY_AUTH_MODE=token", opened, "192.0.2.77:6379")


def test_without_ray_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    refused(r"realsim\[cluster\]", opened, "local")


def test_a_machine_with_another_version_does_nothing_and_is_named():
    (told,) = on_node("0.0.7", "run", (), b"", {})
    assert "realsim" in told and "this one 0.0.7" in told
    error = _ending("foreign", told)
    assert isinstance(error, many.ForeignNodeError) and "Install the same version" in str(error)


@pytest.mark.parametrize("is_stored", [False, True])
def test_a_machine_whose_disk_is_full_counts_as_lost(is_stored, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    job = pickle.dumps((many_tasks.fills_the_disk, (str(tmp_path), is_stored)))
    (ended,) = work("run", job, lambda digest: b"")
    found = _ending("ended", ended)
    assert isinstance(found, many.WorkerDiedError) and "the disk of" in str(found)


# --- one machine ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster():
    pytest.importorskip("ray")
    with many.open_pool(many.PoolConfig(workers=2, address="local")) as pool:
        yield pool


def ran(pool, *tasks):
    outcomes = {}

    def keep(outcome):
        outcomes[outcome.task.name] = outcome

    named = [many.Task(name=str(k), fn=fn, args=tuple(args)) for k, (fn, *args) in enumerate(tasks)]
    summary = many.run_many(named, pool, keep)
    return summary, [outcomes[t.name] for t in named]


@pytest.mark.slow
def test_tasks_on_a_cluster_do_what_they_do_here(cluster, tmp_path):
    summary, found = ran(
        cluster,
        *((many_tasks.doubled, k) for k in range(8)),
        (many_tasks.odd_fails, 3),
        (many_tasks.dies_first, str(tmp_path), 1),
        (many_tasks.doubled, many.Shared([1, 2])),
    )
    assert [o.value for o in found[:8]] == [2 * k for k in range(8)]
    assert found[8].why == "3 is odd" and isinstance(found[8].error, InputError)
    assert found[9].value == 1 and found[9].deaths == 1
    assert found[10].value == [1, 2, 1, 2] and summary.lost == 1 and summary.done == 10


@pytest.mark.slow
def test_a_task_that_kills_three_workers_is_named(cluster, tmp_path):
    summary, (found,) = ran(cluster, (many_tasks.dies_first, str(tmp_path), 9))
    assert "3 workers ended in the middle of it" in found.why and len(summary.failed) == 1
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.slow
def test_files_travel_and_changes_come_back_or_nothing_does(cluster, tmp_path):
    folder = tmp_path / "worked"
    folder.mkdir()
    for name in ("changed.txt", "log.txt", "gone.txt", "same.txt"):
        (folder / name).write_text("before ")
    untouched = (folder / "same.txt").stat().st_mtime_ns
    summary, found = ran(cluster, (many_tasks.spoils_and_fails, many.Worked(folder)))
    assert found[0].why == "it cannot be done"
    assert {p.read_text() for p in folder.iterdir()} == {"before "} and len(summary.failed) == 1
    _, found = ran(
        cluster,
        (many_tasks.sizes, many.Sent(folder), many.Sent(b"1234")),
        (many_tasks.rewrites, many.Worked(folder), "x"),
    )
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
        _, (found,) = ran(cluster, (many_tasks.sizes, many.Worked(folder)))
        assert "another run is working" in found.why


# --- several machines, and commands ---------------------------------------------------------------


@pytest.fixture(scope="module")
def nodes():
    pytest.importorskip("ray")
    with ray_on_loopback.two_nodes() as cluster:
        yield cluster


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The scenes that one machine makes."""
    said, scenes = ray_on_loopback.generated(tmp_path_factory.mktemp("whole") / "out")
    assert said.returncode == 0 and scenes, said.stderr
    return scenes


@pytest.mark.slow
def test_of_two_nodes_one_is_killed_and_the_result_is_that_of_one_machine(nodes, whole, tmp_path):
    assert not ray_on_loopback.listening_beyond_loopback(nodes[0])
    at, said, scenes = ray_on_loopback.generated_with_a_loss(tmp_path / "out", nodes, "node")
    assert 1 <= at < ray_on_loopback.SCENES, "the node was killed in the middle"
    assert said.returncode == 0, said.stderr
    assert scenes == whole and not list(tmp_path.rglob("*.part"))


@pytest.mark.slow
def test_a_lost_head_ends_in_a_sentence_and_the_same_command_goes_on(nodes, whole, tmp_path):
    out = tmp_path / "out"
    at, said, kept = ray_on_loopback.generated_with_a_loss(out, nodes, "head")
    assert 1 <= at < ray_on_loopback.SCENES, "the head was killed in the middle"
    assert said.returncode == 2
    told = [line for line in said.stderr.splitlines() if line.strip()]
    assert told[-1].startswith("error: the Ray cluster (127.0.0.1:")
    assert "is lost: its head is gone. Until then" in told[-1] and "goes on from here" in told[-1]
    assert not any("ray." in line or "Traceback" in line for line in told), told
    assert kept and kept.items() <= whole.items()
    again, scenes = ray_on_loopback.generated(out)
    assert again.returncode == 0 and scenes == whole and not list(out.rglob("*.part"))


INTERRUPTED = """
import time
from realsim.app import cli
from realsim.many import PoolConfig, Task, open_pool, run_many

def work():
    tasks = [Task(name=str(s), fn=time.sleep, args=(s,)) for s in (0, 600)]
    with open_pool(PoolConfig(workers=1, address="local")) as pool:
        # The first counts as done before the second is told to be under way.
        second = lambda names: names == ["600"] and print("one is done", flush=True)
        run_many(tasks, pool, lambda outcome: None, tick=second)

cli.commands.command("work")(work)
cli.main()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("send", "number", "code"),
    [(os.killpg, signal.SIGINT, 130), (os.kill, signal.SIGTERM, 143)],  # a terminal tells all
)
def test_ctrl_c_and_sigterm_end_in_a_sentence(send, number, code):
    pytest.importorskip("ray")
    run = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED, "work"], start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert run.stdout.readline() == "one is done\n"
    send(run.pid, number)
    told = run.communicate(timeout=30)[1].strip()
    assert run.returncode == code and told.splitlines()[-1].startswith("interrupted: 1 task is")
    assert told.endswith("; the same command goes on from here.") and "Traceback" not in told
