"""Reads mutated samples in processes that may die: each has a limit of memory and of time.

A worker is forked from a process that has imported everything, reads the whole sample once, and
then has 1 GB more than that. The kernel ends it after 5 s of CPU on one mutation, its parent after
30 s of waiting; either costs that mutation only.
"""

import contextlib
import dataclasses
import multiprocessing as mp
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator, Mapping
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from formats_mutations_changes import Files, mutated
from formats_mutations_scenes import Sample

from realsim.errors import RealsimError

HEADROOM_BYTES = 1 << 30
CPU_S, WALL_S, WARM_S = 5, 30, 60
"""Limits of one mutation; the whole sample may wait longer: libraries are compiled first."""
BATCH = 25
"""Mutations that a worker gets at once."""
NAN_ALLOWED = frozenset(
    # A grasp that was not tried, or that says no more, has NaN by the record's own meaning.
    "scores base_scores slip_m slip_rad widths_m openings_m measures values_m".split()
)


class Outcome(NamedTuple):
    """What became of one mutation."""

    name: str
    seed: int
    kind: str
    """read, refused, traceback, nan, hang, memory or crash."""
    change: str
    detail: str
    """The end of the traceback, or the message."""
    peak_mb: float = 0.0
    """The most memory that its process, or one of its own, has had so far."""


class Job(NamedTuple):
    """Mutations of one sample."""

    name: str
    seeds: tuple[int, ...]


def sample_files(sample: Sample) -> Files:
    """Return the files of a sample, made in a folder that is gone again."""
    with tempfile.TemporaryDirectory(prefix="mutations-") as name:
        folder = Path(name) / "sample"
        folder.mkdir()
        sample.make(folder)
        return {
            p.relative_to(folder).as_posix(): p.read_bytes()
            for p in sorted(folder.rglob("*"))
            if p.is_file()
        }


def write_files(files: Mapping[str, bytes | None], folder: Path) -> None:
    """Write a sample; None is a folder in the place of a file."""
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if data is None:
            path.mkdir()
        else:
            path.write_bytes(data)


def read_mutation(sample: Sample, files: Files, seed: int, known: frozenset[str]) -> Outcome:
    """Read a sample with one change; `known` are the fields in which the whole one has NaN."""
    changed, change = mutated(files, seed)
    with tempfile.TemporaryDirectory(prefix="mutations-") as name:
        folder = Path(name) / "sample"
        folder.mkdir()
        write_files(changed, folder)
        kind, detail = "read", ""
        try:
            found = sample.read(folder)
            strange = sorted(not_finite(found) - known)
            if strange:
                kind, detail = "nan", ", ".join(strange)
        except RealsimError as error:
            kind, detail = "refused", str(error).replace(str(folder), "SAMPLE")[:300]
        except MemoryError:
            kind, detail = "memory", _tail()
        except Exception:
            kind, detail = "traceback", _tail()
        return Outcome(sample.name, seed, kind, change, detail)


def _tail() -> str:
    lines = traceback.format_exc().splitlines()
    return "\n".join([*lines[-14:-1], lines[-1][:300]])


def not_finite(value: Any, name: str = "", depth: int = 0) -> set[str]:
    """Return the fields of records in which there are numbers that are not finite."""
    if depth > 12 or value is None or isinstance(value, (str, bytes, int, Path)):
        return set()
    if isinstance(value, (float, np.floating)):
        return set() if np.isfinite(value) else {name}
    if isinstance(value, np.ndarray):
        is_number = value.dtype.kind == "f"
        return {name} if is_number and not np.isfinite(value).all() else set()
    inner: list[tuple[str, Any]] = []
    if isinstance(value, Mapping):
        inner = [(name if not isinstance(k, str) else f"{name}.{k}", v) for k, v in value.items()]
    elif dataclasses.is_dataclass(value):
        kind = type(value).__name__
        inner = [
            (f"{kind}.{f.name}", getattr(value, f.name))
            for f in dataclasses.fields(value)
            if f.name not in NAN_ALLOWED
        ]
    elif isinstance(value, (list, tuple)):
        inner = [(name, v) for v in value]
    found: set[str] = set()
    for label, item in inner:
        found |= not_finite(item, label, depth + 1)
    return found


# --- the worker -----------------------------------------------------------------------------------


def work(
    pipe: Connection, theirs: Connection, samples: Mapping[str, Sample], files: Mapping[str, Files]
) -> None:
    """Read batches of mutations until the pipe closes, also as its other end dies."""
    theirs.close()
    scratch = tempfile.mkdtemp(prefix="mutations-worker-")
    tempfile.tempdir = scratch
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _quiet()
    try:
        pipe.send(scratch)
        while (job := pipe.recv()) is not None:
            _run_job(pipe, samples[job.name], files[job.name], job)
    except (EOFError, OSError):
        pass
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    os._exit(0)


def _run_job(pipe: Connection, sample: Sample, files: Files, job: Job) -> None:
    known = _warmed_up(sample, files)
    top = _address_space() + HEADROOM_BYTES
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (top, hard))
    try:
        for seed in job.seeds:
            pipe.send(("begin", seed))
            before = time.process_time()
            limit = int(before) + CPU_S + 2
            resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))
            outcome = read_mutation(sample, files, seed, known)
            if time.process_time() - before > CPU_S:
                outcome = outcome._replace(kind="hang")
            used = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
            peak = max(resource.getrusage(who).ru_maxrss for who in used) / 1024
            pipe.send(("end", outcome._replace(peak_mb=peak)))
    finally:
        resource.setrlimit(resource.RLIMIT_CPU, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        resource.setrlimit(resource.RLIMIT_AS, (hard, hard))


def _warmed_up(sample: Sample, files: Files) -> frozenset[str]:
    """Read the whole sample, so that libraries have their threads; return its fields with NaN."""
    with tempfile.TemporaryDirectory(prefix="mutations-") as name:
        folder = Path(name) / "sample"
        folder.mkdir()
        write_files(files, folder)
        return frozenset(not_finite(sample.read(folder)))


def _quiet() -> None:
    """Libraries complain of damaged files on standard error; that is not looked at here."""
    warnings.simplefilter("ignore")
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    os.dup2(null, 1)
    sys.stdout = sys.stderr = open(os.devnull, "w")


def _address_space() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


# --- the parent -----------------------------------------------------------------------------------


class _Worker:
    """A process, the batch it has, and the mutation it is at."""

    def __init__(self, samples: Mapping[str, Sample], files: Mapping[str, Files]) -> None:
        context = mp.get_context("fork")
        self.pipe, its = context.Pipe()
        given = (its, self.pipe, samples, files)
        self.process = context.Process(target=work, args=given, daemon=True)
        self.process.start()
        its.close()
        self.scratch = str(self.pipe.recv())
        self.job: Job | None = None
        self.at: int | None = None
        self.since = time.monotonic()
        self.done = 0

    def give(self, job: Job) -> None:
        self.job, self.at, self.done, self.since = job, None, 0, time.monotonic()
        self.pipe.send(job)

    def is_late(self) -> bool:
        limit = WARM_S if self.at is None else WALL_S
        return time.monotonic() - self.since > limit

    def end(self) -> None:
        with contextlib.suppress(OSError):
            self.pipe.send(None)
        self.process.join(2)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.pipe.close()
        shutil.rmtree(self.scratch, ignore_errors=True)


def outcomes(samples: Mapping[str, Sample], jobs: list[Job], workers: int) -> Iterator[Outcome]:
    """Yield what became of every mutation, in the order in which they end."""
    files = {name: sample_files(samples[name]) for name in dict.fromkeys(j.name for j in jobs)}
    waiting = list(reversed(jobs))
    pool = [_Worker(samples, files) for _ in range(min(workers, len(jobs)))]
    try:
        while waiting or any(w.job for w in pool):
            for worker in pool:
                if worker.job is None and waiting:
                    worker.give(waiting.pop())
            for ready in wait([w.pipe for w in pool if w.job], timeout=1.0):
                worker = next(w for w in pool if w.pipe is ready)
                try:
                    yield from _heard(worker)
                except (EOFError, OSError):
                    yield from _lost(worker, pool, samples, files, waiting)
            for worker in [w for w in pool if w.job and w.is_late()]:
                worker.process.kill()
                yield from _lost(worker, pool, samples, files, waiting, late=True)
    finally:
        for worker in pool:
            worker.end()


def _heard(worker: _Worker) -> Iterator[Outcome]:
    what, value = worker.pipe.recv()
    worker.since = time.monotonic()
    if what == "begin":
        worker.at = value
        return
    worker.at = None
    worker.done += 1
    if worker.job is not None and worker.done == len(worker.job.seeds):
        worker.job = None
    yield value


def _lost(
    worker: _Worker, pool: list[_Worker], samples: Mapping[str, Sample],
    files: Mapping[str, Files], waiting: list[Job], *, late: bool = False,
) -> Iterator[Outcome]:  # fmt: skip
    """Say which mutation ended a worker, and put another in its place."""
    job = worker.job
    assert job is not None
    worker.process.join(5)
    code = worker.process.exitcode
    if worker.at is None and worker.done == 0:
        raise RuntimeError(f"the whole sample '{job.name}' cannot be read (exit code {code}).")
    seed = job.seeds[worker.done] if worker.at is None else worker.at
    is_hang = late or code == -signal.SIGXCPU
    change = mutated(files[job.name], seed)[1]
    yield Outcome(job.name, seed, "hang" if is_hang else "crash", change, f"exit code {code}")
    rest = job.seeds[worker.done + 1 :]
    worker.end()
    if rest:
        waiting.append(Job(job.name, rest))
    pool[pool.index(worker)] = _Worker(samples, files)
