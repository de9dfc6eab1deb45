"""Damaged files of every format end in realsim's own error or in a correct read."""

import importlib
import sys
import time
from pathlib import Path
from typing import Any

import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
mutations: Any = importlib.import_module("formats_mutations")
changes: Any = importlib.import_module("formats_mutations_changes")
worker: Any = importlib.import_module("formats_mutations_worker")
scenes: Any = importlib.import_module("formats_mutations_scenes")


SOUND = list(mutations.SAMPLES)


def _report(result: Any) -> str:
    return "\n".join(mutations.table(result))


def test_damaged_files_are_refused_or_read() -> None:
    result = mutations.run_mutations(120, 4_000, 2, SOUND)
    assert result.total() == 120
    assert result.offences == 0, _report(result)
    assert result.total("refused") > 30  # the damage is real
    assert result.total("read") > 10  # and not all is fatal


@pytest.mark.slow
def test_many_damaged_files_are_refused_or_read() -> None:
    result = mutations.run_mutations(1600, 50_000, 2, SOUND)
    assert result.total() == 1600
    assert result.offences == 0, _report(result)


def test_the_same_seed_makes_the_same_damage() -> None:
    sample = mutations.SAMPLES["plain files"]
    files = worker.sample_files(sample)
    first = [changes.mutated(files, seed) for seed in range(40)]
    time.sleep(1.1)  # some formats write the second into the file
    assert [changes.mutated(files, seed) for seed in range(40)] == first
    assert sum(changed != files for changed, _ in first) > 35


# --- the harness sees what it is made to see -----------------------------------------------------


def _make(folder: Path) -> None:
    (folder / "a.bin").write_bytes(bytes(100))


def _offence(kind: str) -> Any:
    def read(folder: Path) -> Any:
        data = (folder / "a.bin").read_bytes() if (folder / "a.bin").is_file() else b""
        if data == bytes(100):
            return []  # the whole sample
        if kind == "traceback":
            raise ZeroDivisionError
        if kind == "nan":
            return [{"x": float("nan")}]
        if kind == "memory":
            return [bytes(3 << 30)]
        if kind == "crash":
            import os

            os.abort()
        while True:  # a hang
            pass

    return scenes.Sample(kind, _make, read)


@pytest.mark.parametrize("kind", ["traceback", "nan", "memory", "crash"])
def test_every_class_of_offence_is_seen_and_costs_one_mutation_only(kind: str) -> None:
    sample = _offence(kind)
    jobs = [worker.Job(kind, tuple(range(8)))]
    found = list(worker.outcomes({kind: sample}, jobs, 1))
    assert sorted(o.seed for o in found) == list(range(8))
    assert {o.kind for o in found} <= {kind, "read"}
    assert sum(o.kind == kind for o in found) >= 4


@pytest.mark.slow
def test_a_hang_is_seen() -> None:
    jobs = [worker.Job("hang", (3,))]
    (found,) = worker.outcomes({"hang": _offence("hang")}, jobs, 1)
    assert found.kind == "hang"
