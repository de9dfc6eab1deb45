"""Many tasks on this machine: failures listed, dead workers replaced, files handed over."""

import errno
import math
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Future, wait

import pytest

from many_tasks import dies_first, doubled, odd_fails, sizes, waits_then
from realsim import many
from realsim.errors import InputError
from realsim.many import Sent, Worked
from realsim.many.carried import Incoming, Piece, digest_of, packed
from realsim.store import atomic
from realsim.store.atomic import StorageError
from refusals import refused


@pytest.fixture(scope="module")
def two():
    with many.open_pool(many.PoolConfig(workers=2)) as pool:
        yield pool


def tasks_of(fn, *args):
    return [many.Task(name=f"task {k}", fn=fn, args=given) for k, given in enumerate(args)]


def ran(pool, tasks, **kwargs):
    outcomes = []
    summary = many.run_many(tasks, pool, outcomes.append, **kwargs)
    return outcomes, summary


def test_every_task_is_told_once_whoever_does_it(two):
    tasks = tasks_of(doubled, *((k,) for k in range(20)))
    with many.open_pool(1) as alone:
        found = [ran(where, tasks) for where in (two, alone)]
    for outcomes, summary in found:
        assert sorted(o.value for o in outcomes) == [2 * k for k in range(20)]
        assert {o.task.name: o.value for o in outcomes} == {f"task {k}": 2 * k for k in range(20)}
        assert summary.done == 20 and not summary.failed and str(summary) == "20 tasks are done"


def test_a_failing_task_is_listed_with_its_reason_and_the_rest_go_on(two):
    outcomes, summary = ran(two, tasks_of(odd_fails, (0,), (1,), (2,), (3,), ("x",)))
    assert {o.task.name: o.why for o in summary.failed} == {
        "task 1": "1 is odd",
        "task 3": "3 is odd",
        "task 4": "the program failed: TypeError: not all arguments converted during string "
        "formatting",
    }
    assert len(outcomes) == 5 and str(summary) == "2 tasks are done, 3 failed"
    refused("1 is odd", next(o for o in outcomes if o.task.name == "task 1").found)


def test_a_task_whose_worker_is_killed_is_begun_again(two, tmp_path):
    outcomes, summary = ran(two, tasks_of(dies_first, (str(tmp_path), 2)))
    assert [o.value for o in outcomes] == [2] and summary.lost == 2 and outcomes[0].deaths == 2


def test_a_task_that_kills_three_workers_is_named_and_the_rest_go_on(two, tmp_path):
    deadly = many.Task(name="deadly", fn=dies_first, args=(str(tmp_path), 100))
    _, summary = ran(two, [deadly, *tasks_of(doubled, (1,), (2,))])
    assert [o.task.name for o in summary.failed] == ["deadly"]
    assert isinstance(summary.failed[0].error, many.WorkerDiedError)
    assert "3 workers ended in the middle of it" in summary.failed[0].why
    assert "killed (signal SIGKILL), as the system does when" in summary.failed[0].why
    assert summary.done == 2 and len(list(tmp_path.iterdir())) == 3


def said_by_script(folder, text):
    """Return what a program prints that is a file of its own."""
    (folder / "script.py").write_text(text)
    command = [sys.executable, folder / "script.py"]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60)
    return ran.stdout + ran.stderr


def test_a_script_without_a_guard_is_run_once(tmp_path):
    said = said_by_script(
        tmp_path,
        "import math\nfrom realsim.many import PoolConfig, Task, open_pool, run_many\n"
        "print('begun')\nwith open_pool(PoolConfig(workers=2)) as pool:\n"
        "    done = lambda o: print(o.found())\n"
        "    run_many([Task(name='root', fn=math.sqrt, args=(4.0,))], pool, done)\n",
    )
    assert said == "begun\n2.0\n"


def test_in_a_worker_of_the_users_own_that_may_have_none_the_job_is_done_there(tmp_path):
    said = said_by_script(
        tmp_path,
        "import math, multiprocessing\n"
        "from realsim.many import PoolConfig, Task, open_pool, run_many\n"
        "def work(x):\n"
        "    found = []\n"
        "    with open_pool(PoolConfig(workers=2)) as pool:\n"
        "        run_many([Task(name='root', fn=math.sqrt, args=(x,))], pool, found.append)\n"
        "    return found[0].found()\n"
        "if __name__ == '__main__':\n"
        "    with multiprocessing.get_context('spawn').Pool(1) as own:\n"
        "        print(own.map(work, [4.0]))\n",
    )
    assert said == "[2.0]\n"


def test_results_come_in_order_where_that_is_asked_for(two):
    tasks = tasks_of(waits_then, *((s, k) for k, s in enumerate([0.3, 0.0, 0.0, 0.2, 0.0, 0.0])))
    begun, seen = [], []

    def lazily():
        for task in tasks:
            begun.append(task.name)
            yield task

    def done(outcome):
        seen.append(outcome.value)
        assert len(begun) <= outcome.value + 1 + 2 * two.capacity()

    many.run_many(lazily(), two, done, in_order=True)
    assert seen == list(range(6))


def test_an_outcome_may_bring_further_tasks(two):
    seen = []

    def done(outcome):
        seen.append(outcome.value)
        return tasks_of(doubled, (outcome.value,)) if outcome.value < 40 else None

    summary = many.run_many(tasks_of(doubled, (1,), (3,)), two, done)
    assert sorted(seen) == [2, 4, 6, 8, 12, 16, 24, 32, 48, 64] and summary.done == 10


def test_files_folders_and_bytes_become_paths(two, tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "a").write_bytes(b"12")
    (tmp_path / "file").write_bytes(b"123")
    given = (many.Sent(tmp_path / "folder"), many.Sent(tmp_path / "file"), many.Sent(b"1234"),
             many.Worked(tmp_path / "folder"))  # fmt: skip
    (outcome,), _ = ran(two, tasks_of(sizes, given))
    assert outcome.found() == [{"a": 2}, 3, 4, {"a": 2}]


class Broken:
    """A pool whose jobs, after two good ones, end in an error."""

    shares_files = True

    def __init__(self, error):
        self.error, self.submitted = error, 0

    def capacity(self):
        return 1

    def submit(self, fn, /, *args):
        future = Future()
        self.submitted += 1
        if self.submitted <= 2:
            future.set_result(None)
        else:
            future.set_exception(self.error)
        return future


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (many.ClusterLostError("the head is gone."), "gone. Until then 2 tasks are done, and what"),
        (many.ForeignNodeError("x has realsim 0.0.1"), "x has realsim 0.0.1"),
        (StorageError("no room"), "no room"),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/f"), "disk is full.* goes on from"),
    ],
)
def test_what_would_befall_every_task_ends_the_run_with_a_sentence(error, told):
    expected = StorageError if isinstance(error, OSError) else type(error)
    outcomes, tasks = [], tasks_of(doubled, *[(1,)] * 5)
    refused(told, many.run_many, tasks, Broken(error), outcomes.append, error=expected)
    assert len(outcomes) == 2


def test_ctrl_c_tells_how_far_it_came_and_ends_the_workers():
    done = []

    def stop(outcome):
        done.append(outcome.value)
        if len(done) == 2:
            signal.raise_signal(signal.SIGINT)

    tasks = [*tasks_of(doubled, (1,)), *tasks_of(waits_then, (0.1, 5), (60.0, 7), (60.0, 8))]
    with (
        pytest.raises(KeyboardInterrupt, match="interrupted: 1 task is done"),
        many.open_pool(many.PoolConfig(workers=2)) as pool,
    ):
        many.run_many(tasks, pool, stop)
    assert sorted(done) == [2, 5]


# --- The processes of a pool: one that dies takes down its own job and nothing else.


# Jobs are functions of the standard library: a fresh process cannot import a test file.


def test_jobs_run_in_as_many_other_processes_as_asked_for(two):
    assert two.capacity() == 2
    wait([two.submit(time.sleep, 0.05) for _ in range(2)])
    pids = set()
    # Where others use the cores one of the two may take many of such short jobs.
    for _ in range(100):
        if len(pids) == 2:
            break
        pids |= {f.result() for f in [two.submit(os.getpid), two.submit(os.getpid)]}
    assert len(pids) == 2 and os.getpid() not in pids


def test_a_worker_that_dies_loses_its_own_job_and_is_replaced(two):
    other = two.submit(time.sleep, 0.5)
    dies = two.submit(signal.raise_signal, signal.SIGKILL)
    refused(r"killed \(signal SIGKILL\)", dies.result, timeout=30, error=many.WorkerDiedError)
    assert two.submit(math.sqrt, 4.0).result(timeout=60) == 2.0
    assert other.result(timeout=30) is None


def test_how_a_worker_ended_is_told(two):
    refused("exit code 7", two.submit(os._exit, 7).result, timeout=60, error=many.WorkerDiedError)


def test_what_a_job_raises_comes_out_of_its_result(two):
    refused("math domain error", two.submit(math.sqrt, -1.0).result, timeout=60, error=ValueError)
    with many.open_pool(1) as workers, pytest.raises(ValueError, match="math domain error"):
        workers.submit(math.sqrt, -1.0).result()


def test_every_worker_computes_with_one_thread(two):
    assert two.submit(os.getenv, "OPENBLAS_NUM_THREADS").result(timeout=60) == "1"
    from threadpoolctl import threadpool_info

    with many.open_pool(1) as workers:
        assert {lib["num_threads"] for lib in workers.submit(threadpool_info).result()} <= {1}


def test_an_error_ends_the_workers_in_the_middle_of_their_jobs():
    with pytest.raises(InputError, match="enough"), many.open_pool(2) as workers:
        job = workers.submit(time.sleep, 60.0)
        raise InputError("enough")
    assert not job.done() or job.cancelled() or job.exception() is not None


# --- Files that come back from another machine: all of them or none, never out of their folder.


def test_nothing_is_there_before_everything_has_come(tmp_path):
    (tmp_path / "gone").write_bytes(b"old")
    (tmp_path / "kept").write_bytes(b"old")
    incoming = Incoming(tmp_path)
    incoming.take(Piece("kept", b"ne", is_first=True, is_last=False))
    incoming.take(Piece("kept", b"w", is_first=False, is_last=True))
    incoming.take(Piece("below/new", b"", is_first=True, is_last=True))
    assert (tmp_path / "kept").read_bytes() == b"old" and not (tmp_path / "below/new").exists()
    incoming.commit(("gone",))
    found = {p.relative_to(tmp_path).as_posix(): p.read_bytes() for p in tmp_path.rglob("*.*")}
    assert not found and not (tmp_path / "gone").exists()
    assert (tmp_path / "kept").read_bytes() == b"new" and (tmp_path / "below/new").is_file()


def test_what_is_dropped_leaves_no_trace(tmp_path):
    incoming = Incoming(tmp_path)
    incoming.take(Piece("a", b"1", is_first=True, is_last=True))
    assert list(tmp_path.iterdir())
    incoming.drop()
    assert not list(tmp_path.iterdir())


def test_a_full_disk_here_is_told_and_nothing_is_changed(tmp_path, monkeypatch):
    (tmp_path / "a").write_bytes(b"old")
    incoming = Incoming(tmp_path)

    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    piece = Piece("a", b"new", is_first=True, is_last=True)
    refused(r"no room for 'a'.*goes on from here", incoming.take, piece, error=StorageError)
    incoming.drop()
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {"a": b"old"}


@pytest.mark.parametrize("name", ["../a", "/etc/a", "b/../../a"])
def test_a_path_that_leads_out_is_refused(name, tmp_path):
    piece = Piece(name, b"1", is_first=True, is_last=True)
    refused("leads out of its folder", Incoming(tmp_path).take, piece)
    refused("leads out of its folder", Incoming(tmp_path).commit, (name,))


def test_files_are_named_by_their_bytes_and_leftovers_stay_behind(tmp_path):
    folder = tmp_path / "s"
    for name in ("a/x", "b/x", "b/y"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(name[-1:].encode())
    atomic.temporary(folder / "b/z").write_bytes(b"half")
    ((all_of_it, part), needed, worked) = packed((Sent(folder), Worked(folder, ("b/*",))), tmp_path)
    assert [name for name, _ in all_of_it.files] == ["a/x", "b/x", "b/y"]
    assert [name for name, _ in part.files] == ["b/x", "b/y"] and part.is_worked
    assert len(needed) == 2 and worked == [Worked(folder, ("b/*",))]
    assert all(digest_of(path) == digest for digest, path in needed.items())
    before = digest_of(folder / "a/x")
    (folder / "a/x").write_bytes(b"changed")
    assert digest_of(folder / "a/x") != before


def test_what_is_not_there_and_two_changed_folders_are_refused(tmp_path):
    refused("is not there, and a job needs it", packed, (Sent(tmp_path / "none"),), tmp_path)
    refused("one folder at most; it names 2", packed, (Worked(tmp_path),) * 2, tmp_path)
