"""Damaged files of every format: each is read correctly or refused, by realsim's own error.

Imported by `formats.py` (`--part damage`); one mutation alone, for a debugger:

    uv run python benchmarks/formats_mutations.py NAME:SEED

Classes: 'read' and 'refused' are right; 'traceback' (any other exception), 'nan' (a record with a
number that is not finite, which the whole sample does not have), 'hang' (5 s of CPU or 20 s of
waiting), 'memory' (1 GB more than the whole sample) and 'crash' (of the process) are offences.
"""

import os

import blas_threads  # noqa: F401

os.environ.setdefault("MALLOC_ARENA_MAX", "2")  # an arena a thread would count as memory

import sys
import tempfile
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from formats_mutations_files import FILES
from formats_mutations_scenes import SCENES, Sample
from formats_mutations_worker import BATCH, Job, Outcome, outcomes, read_mutation, sample_files
from reliability_own import OWN

SAMPLES = {sample.name: sample for sample in (*SCENES, *FILES, *OWN)}
CLASSES = ("read", "refused", "traceback", "nan", "hang", "memory", "crash")
RIGHT = ("read", "refused")
OFFENDERS_KEPT = 20
SEEDS_APART = 1_000_003
"""A format's seeds: this many apart from the next one's."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MutationResult:
    """What became of the mutations."""

    counts: dict[str, dict[str, int]]
    """Format -> class -> how many."""
    offenders: tuple[Outcome, ...]
    """The first twenty that were neither read nor refused."""

    def total(self, *classes: str) -> int:
        """Return how many mutations of all formats ended in these classes; none named = all."""
        return sum(
            n for row in self.counts.values() for c, n in row.items() if not classes or c in classes
        )

    @property
    def offences(self) -> int:
        """How many were neither read nor refused."""
        return self.total() - self.total(*RIGHT)


def run_mutations(
    count: int, seed: int, workers: int, formats: Collection[str] | None = None
) -> MutationResult:
    """Read mutated samples.

    Args:
        count: mutations, shared evenly among the formats.
        seed: the same seed makes the same mutations, whatever the number of workers.
        workers: processes.
        formats: names of samples; None = all.
    """
    names = list(SAMPLES if formats is None else formats)
    jobs = _jobs(names, count, seed)
    counts = {name: dict.fromkeys(CLASSES, 0) for name in names}
    offenders: list[Outcome] = []
    for outcome in outcomes(SAMPLES, jobs, workers):
        counts[outcome.name][outcome.kind] += 1
        if outcome.kind not in RIGHT:
            offenders.append(outcome)
    offenders.sort(key=lambda o: (names.index(o.name), o.seed))
    return MutationResult(counts=counts, offenders=tuple(offenders[:OFFENDERS_KEPT]))


def _jobs(names: list[str], count: int, seed: int) -> list[Job]:
    jobs: list[Job] = []
    for k, name in enumerate(names):
        share = count // len(names) + (k < count % len(names))
        first = seed + SEEDS_APART * list(SAMPLES).index(name)
        for start in range(0, share, BATCH):
            jobs.append(Job(name, tuple(range(first + start, first + min(start + BATCH, share)))))
    return jobs


def replay(name: str, seed: int) -> Outcome:
    """Read one mutation in this process, for a debugger."""
    sample: Sample = SAMPLES[name]
    files = sample_files(sample)
    with tempfile.TemporaryDirectory():
        return read_mutation(sample, files, seed, frozenset())


if __name__ == "__main__":
    name, _, seed = sys.argv[1].rpartition(":")
    print("\n".join(map(str, replay(name, int(seed)))))
