"""Damaged files of every format end in realsim's own error or in a correct read."""

import importlib
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
mutations: Any = importlib.import_module("formats_mutations")

worker: Any = importlib.import_module("formats_mutations_worker")
scenes: Any = importlib.import_module("formats_mutations_scenes")


SOUND = list(mutations.SAMPLES)


def test_damaged_files_are_refused_or_read() -> None:
    found = list(mutations.mutations(40, 4_000, 1, SOUND[::5]))
    assert len(found) == 40
    assert [o for o in found if o.kind not in mutations.RIGHT] == []
    assert sum(o.kind == "refused" for o in found) > 10  # the damage is real
    assert sum(o.kind == "read" for o in found) > 3  # and not all is fatal


@pytest.mark.slow
def test_many_damaged_files_are_refused_or_read() -> None:
    done = {(o.name, o.seed) for o in mutations.mutations(40, 50_000, 2)}
    found = list(mutations.mutations(300, 50_000, 2, done=done))
    assert len(found) == 260 and done.isdisjoint((o.name, o.seed) for o in found)
    assert [o for o in found if o.kind not in mutations.RIGHT] == []


# --- the harness sees what it is made to see -----------------------------------------------------


def _make(folder: Path) -> None:
    (folder / "a.bin").write_bytes(bytes(100))


def _offence(kind: str) -> Any:
    def read(folder: Path) -> Any:
        data = (folder / "a.bin").read_bytes() if (folder / "a.bin").is_file() else b""
        if data == bytes(100):
            return []  # the whole sample
        if kind == "nan":
            return [{"x": float("nan")}]
        if kind == "crash":
            import os

            os.abort()
        while True:  # a hang
            pass

    return scenes.Sample(kind, _make, read)


@pytest.mark.parametrize("kind", ["nan", pytest.param("crash", marks=pytest.mark.slow)])
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
