"""Damaged files of every format: each is read correctly or refused, by realsim's own error.

Imported by `reliability.py` (`--part fuzz`); one mutation alone, for a debugger:

    uv run python benchmarks/formats_mutations.py NAME:SEED

Classes: 'read' and 'refused' are right; 'traceback' (any other exception), 'nan' (a record with a
number that is not finite, which the whole sample does not have), 'hang' (5 s of CPU or 30 s of
waiting), 'memory' (1 GB more than the whole sample) and 'crash' (of the process) are offences.
"""

import os

import blas_threads  # noqa: F401

os.environ.setdefault("MALLOC_ARENA_MAX", "2")  # an arena a thread would count as memory

import sys
from collections.abc import Collection, Container, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from formats_mutations_files import FILES
from formats_mutations_scenes import SCENES
from formats_mutations_worker import BATCH, Job, Outcome, outcomes, read_mutation, sample_files
from reliability_own import OWN

SAMPLES = {sample.name: sample for sample in (*SCENES, *FILES, *OWN)}
RIGHT = ("read", "refused")
SEEDS_APART = 1_000_003
"""A format's seeds: this many apart from the next one's."""


def mutations(
    count: int,
    seed: int,
    workers: int,
    formats: Collection[str] = tuple(SAMPLES),
    done: Container[tuple[str, int]] = (),
) -> Iterator[Outcome]:
    """Read mutated samples, a batch of every format in turn.

    Args:
        count: mutations, shared evenly among the formats.
        seed: the same seed makes the same mutations, whatever the number of workers.
        workers: processes.
        formats: names of samples.
        done: names and seeds that are left out.
    """
    jobs: list[Job] = []
    for start in range(0, -(-count // len(formats)), BATCH):
        for k, name in enumerate(formats):
            share = count // len(formats) + (k < count % len(formats))
            first = seed + SEEDS_APART * list(SAMPLES).index(name)
            seeds = range(first + start, first + min(start + BATCH, share))
            jobs.append(Job(name, tuple(n for n in seeds if (name, n) not in done)))
    return outcomes(SAMPLES, [job for job in jobs if job.seeds], workers)


def replay(name: str, seed: int) -> Outcome:
    """Read one mutation in this process, for a debugger."""
    return read_mutation(SAMPLES[name], sample_files(SAMPLES[name]), seed, frozenset())


if __name__ == "__main__":
    name, _, seed = sys.argv[1].rpartition(":")
    print("\n".join(map(str, replay(name, int(seed)))))
