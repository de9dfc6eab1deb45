"""The processes of a pool: one that dies takes down its own job and nothing else."""

import math
import os
import signal
import time
from concurrent.futures import wait

import pytest

from realsim.errors import InputError
from realsim.many import WorkerDiedError, open_pool
from refusals import refused


@pytest.fixture(scope="module")
def two():
    with open_pool(2) as workers:
        # Jobs are functions of the standard library: a fresh process cannot import a test file.
        wait([workers.submit(os.getpid), workers.submit(os.getpid)])
        yield workers


def test_jobs_run_in_as_many_other_processes_as_asked_for(two):
    assert two.capacity() == 2
    sleeps = [two.submit(time.sleep, 0.05) for _ in range(2)]
    wait(sleeps)
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
    refused(r"killed \(signal SIGKILL\)", dies.result, timeout=30, error=WorkerDiedError)
    next_one = two.submit(math.sqrt, 4.0)
    assert next_one.result(timeout=60) == 2.0
    assert other.result(timeout=30) is None


def test_how_a_worker_ended_is_told(two):
    refused("exit code 7", two.submit(os._exit, 7).result, timeout=60, error=WorkerDiedError)


def test_what_a_job_raises_comes_out_of_its_result(two):
    refused("math domain error", two.submit(math.sqrt, -1.0).result, timeout=60, error=ValueError)
    with open_pool(1) as workers, pytest.raises(ValueError, match="math domain error"):
        workers.submit(math.sqrt, -1.0).result()


def test_every_worker_computes_with_one_thread(two):
    assert two.submit(os.getenv, "OPENBLAS_NUM_THREADS").result(timeout=60) == "1"
    from threadpoolctl import threadpool_info

    with open_pool(1) as workers:
        assert {lib["num_threads"] for lib in workers.submit(threadpool_info).result()} <= {1}


def test_an_error_ends_the_workers_in_the_middle_of_their_jobs():
    with pytest.raises(InputError, match="enough"), open_pool(2) as workers:
        job = workers.submit(time.sleep, 60.0)
        raise InputError("enough")
    assert not job.done() or job.cancelled() or job.exception() is not None
