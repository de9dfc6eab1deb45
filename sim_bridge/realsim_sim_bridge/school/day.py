"""A day at school: every object's preparation, then its grasps in shards, on whatever workers."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from realsim.arrays import Array, Rows
from realsim.errors import RealsimError
from realsim.geometry import se3
from realsim.geometry.mesh import hull_vertices
from realsim.many import Outcome, Pool, Sent, Task, WorkerDiedError, run_many
from realsim.models.convex import convex_parts
from realsim_sim_bridge.school import cache_folder
from realsim_sim_bridge.school.object_task import ObjectTask, Prepared, prepare, trial_of, untried
from realsim_sim_bridge.school.shards import (
    Tested,
    in_words,
    read_tested,
    result_of,
    run_shard,
    shards_of,
    stand_of,
    write_tested,
)
from realsim_sim_bridge.slip.stand import Stand

Progress = Callable[[int, int], None]


@dataclass(eq=False, kw_only=True, slots=True)
class Pupil:
    """One object on its way through the school."""

    task: ObjectTask
    folder: Path | None
    """Where its files are kept; None = nowhere."""
    shard_grasps: int
    result: cache_folder.SchoolResult | None = None
    prepared: Prepared | None = None
    shards: list[Rows] = field(default_factory=list[Rows])
    tested: list[Tested] = field(default_factory=list[Tested])
    given_up: list[tuple[Rows, str]] = field(default_factory=list[tuple[Rows, str]])
    stand: Stand | None = None
    standing: dict[str, Any] | None = None
    """What the set's parameters say of the stand."""

    def __post_init__(self) -> None:
        """Take from the folder whatever has been done before."""
        path = self.path("grasps")
        self.result = None if path is None else cache_folder.read_result(path)
        path = self.path("prepared")
        if self.result is None and path is not None:
            prepared = cache_folder.read_prepared(path)
            if prepared is not None:
                self._divide(prepared)

    def path(self, what: str) -> Path | None:
        """Return where `what` of this object is kept."""
        if self.folder is None:
            return None
        return self.folder / f"instance_{self.task.instance:06d}.{what}.npz"

    @property
    def name(self) -> str:
        """The object in words."""
        return f"object '{self.task.name}' (instance {self.task.instance})"

    @property
    def open_shards(self) -> list[Rows]:
        """The shards of which nothing is known yet."""
        done = {int(t.rows[0]) for t in self.tested}
        done |= {int(rows[0]) for rows, _ in self.given_up if len(rows)}
        return [rows for rows in self.shards if int(rows[0]) not in done]

    @property
    def judged(self) -> int:
        """How many grasps are done."""
        if self.result is not None:
            return len(self.result.grasp_set)
        if self.prepared is None:
            return 0
        waiting = sum(len(rows) for rows in self.open_shards)
        return len(self.prepared.widths_m) - waiting

    @property
    def expected(self) -> int:
        """How many there will be, as far as it is known."""
        if self.result is not None:
            return len(self.result.grasp_set)
        if self.prepared is None:
            return self.task.config.max_candidates
        return len(self.prepared.widths_m)

    def take_prepared(self, prepared: Prepared, *, keep: bool = True) -> None:
        """Keep the preparation and divide the grasps into shards."""
        path = self.path("prepared")
        if path is not None and keep:
            cache_folder.write_prepared(path, prepared)
        self._divide(prepared)

    def _divide(self, prepared: Prepared) -> None:
        """Divide the grasps into shards and take those tested before from the folder."""
        self.prepared = prepared
        self.shards = shards_of(prepared.tested, self.shard_grasps)
        for rows in self.shards:
            path = self._shard_path(rows)
            tested = None if path is None else read_tested(path)
            if tested is not None:
                self.tested.append(tested)

    def parts(self) -> list[Array] | None:
        """Return the convex parts (V, 3) that the engine has of it, table frame; None = none."""
        task = self.task
        if self.prepared is not None:
            own = None if self.prepared.body is None else self.prepared.body.parts
        elif self.result is None or "convex" not in self.result.grasp_set.parameters:
            own = None
        elif task.solid is not None:
            own = task.solid.parts.parts
        else:
            own = convex_parts(task.mesh, task.config.convex, task.cache).parts
        return None if own is None else [se3.transform(task.T_table_obj, part) for part in own]

    def stand_among(self, others: Mapping[int, list[Array]]) -> None:
        """Find what the object stands on and beside while fingers close on it.

        A neighbour whose convex parts nobody has cut (it is rejected, or not tried) is the convex
        hull of its surface.

        Args:
            others: convex parts by instance, as far as there are any.
        """
        assert self.prepared is not None, "an object stands after its preparation"
        task, around = self.task, self.task.neighbours
        own = {i: others.get(int(i)) for i in np.unique(around.triangle_instances)}
        hulls = {
            i: [hull_vertices(around.triangles[around.triangle_instances == i])]
            for i, parts in own.items()
            if parts is None
        }
        pieces = [part for parts in ({**own, **hulls}).values() for part in parts or ()]
        self.stand = stand_of(task.config.slip, task.T_table_obj, self.prepared.body, pieces)
        if self.stand is not None:
            self.standing = {
                "table_height_m": self.stand.height_m,
                "neighbour_parts": len(self.stand.obstacles),
                "neighbour_parts_moved_m": self.stand.moved_m,
                "neighbour_parts_left_out": self.stand.left_out,
                "neighbours_as_hulls": [int(i) for i in hulls],
            }

    def take_tested(self, tested: Tested) -> None:
        """Keep what was found of a shard."""
        path = self._shard_path(tested.rows)
        if path is not None:
            write_tested(path, tested)
        self.tested.append(tested)

    def finish(self) -> None:
        """Put the result together, keep it, and drop the pieces it was made of.

        One with a job that was given up is not kept, so that the next run tries that job again.
        """
        assert self.prepared is not None, "a pupil finishes after its preparation"
        self.result = result_of(self.task, self.prepared, self.tested, self.given_up, self.standing)
        path = self.path("grasps")
        if path is None or self.given_up:
            return
        cache_folder.write_result(path, self.result)
        for piece in [self.path("prepared"), *(self._shard_path(rows) for rows in self.shards)]:
            if piece is not None:
                piece.unlink(missing_ok=True)

    def _shard_path(self, rows: Rows) -> Path | None:
        """Return where a shard's result is kept."""
        return self.path(f"shard_{int(rows[0]):06d}")


def so_far(pupils: Sequence[Pupil]) -> tuple[int, int]:
    """Return how many grasps are judged, and how many there are."""
    return sum(p.judged for p in pupils), sum(p.expected for p in pupils)


class Day:
    """Hands out preparations and shards; this process alone writes the files."""

    def __init__(self, pool: Pool, pupils: list[Pupil], progress: Progress | None) -> None:
        self._pool, self._pupils, self._progress = pool, pupils, progress

    def run(self) -> None:
        """Work until every pupil has its result.

        Raises:
            RealsimError: a job met input that it cannot use; object and grasps are named.
        """
        unprepared = [p for p in self._pupils if p.result is None and p.prepared is None]
        first = [self._preparation(p) for p in unprepared] if unprepared else self._tests()
        self._report()
        run_many(first, self._pool, self._take)

    def _preparation(self, pupil: Pupil) -> Task:
        """Return the task of preparing an object."""
        task = pupil.task if self._pool.shares_files else replace(pupil.task, cache=None)
        labels = None if task.labels_file is None else Sent(task.labels_file)
        return _Job(name=f"{pupil.name}, preparation", fn=prepare, args=(task, labels), pupil=pupil)

    def _take(self, outcome: Outcome) -> Iterable[Task]:
        """Take what a job came to; return those that come out of it."""
        job: Task = outcome.task
        more: Iterable[Task] = ()
        assert isinstance(job, _Job), "the day hands out no other tasks"
        gave_up = isinstance(outcome.error, WorkerDiedError)
        if outcome.error is not None and not gave_up:
            raise _with_name(outcome.error, job.name) from None
        if job.rows is None:
            if gave_up:
                nothing = untried(job.pupil.task, f"the preparation failed: {outcome.why}")
                job.pupil.take_prepared(nothing, keep=False)
                job.pupil.given_up.append((np.zeros(0, dtype=np.int64), outcome.why))
            else:
                job.pupil.take_prepared(outcome.value)
            more = self._tests()
        else:
            if gave_up:
                job.pupil.given_up.append((job.rows, outcome.why))
            else:
                job.pupil.take_tested(outcome.value)
            _finish_if_done(job.pupil)
        self._report()
        return more

    def _tests(self) -> Iterable[Task]:
        """Return the slip tests that are due, once every object is prepared.

        Fingers close on an object among its neighbours, whose convex parts are known by then.
        """
        open_ones = [pupil for pupil in self._pupils if pupil.result is None]
        if any(pupil.prepared is None for pupil in open_ones):
            return ()
        found = {p.task.instance: p.parts() for p in self._pupils} if open_ones else {}
        parts = {instance: own for instance, own in found.items() if own is not None}
        due = [(pupil, rows) for pupil in open_ones for rows in pupil.open_shards]
        for pupil in open_ones:
            pupil.stand_among(parts)
            _finish_if_done(pupil)
        return (_test(pupil, rows) for pupil, rows in due)

    def _report(self) -> None:
        """Tell how many grasps are judged."""
        if self._progress is not None:
            self._progress(*so_far(self._pupils))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Job(Task):
    """A preparation, or the test of a shard."""

    pupil: Pupil
    rows: Rows | None = None
    """None = the preparation."""


def _test(pupil: Pupil, rows: Rows) -> Task:
    """Return the slip test of a shard."""
    assert pupil.prepared is not None, "shards come out of a preparation"
    trial = trial_of(pupil.task, pupil.prepared, rows, pupil.stand)
    return _Job(
        name=f"{pupil.name}, {in_words(rows)}", fn=run_shard, pupil=pupil, rows=rows,
        args=(trial, rows, pupil.task.config),
    )  # fmt: skip


def _finish_if_done(pupil: Pupil) -> None:
    """Put a pupil's result together after its last shard."""
    if not pupil.open_shards:
        pupil.finish()


def _with_name(error: Exception, job: str) -> Exception:
    """Return an error that says in which job it came up."""
    if isinstance(error, RealsimError):
        return type(error)(f"{job}: {error}")
    error.add_note(f"in the Robot School: {job}")
    return error
