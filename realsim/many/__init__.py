"""One way to run many: tasks on processes of this machine, or on a Ray cluster, by one interface.

    from realsim.many import PoolConfig, Sent, Task, Worked, open_pool, run_many

    def count(names: Path, session: Path) -> int: ...      # a function of a module

    tasks = (Task(name=s.name, fn=count, args=(Sent(names_file), Sent(s))) for s in sessions)

    def keep(outcome: Outcome) -> None:                    # in this process: the one writer
        if outcome.error is not None:
            console.warn(f"{outcome.task.name}: {outcome.why}")
        else:
            atomic.write_json(out / f"{outcome.task.name}.json", outcome.value)

    with open_pool(PoolConfig(workers=8)) as pool:         # or address="HOST:PORT" or "local"
        summary = run_many(tasks, pool, keep)

What a task is given can be pickled, and so can what it returns. `Sent(path)` in its arguments is a
file or a folder that it reads, `Worked(folder)` the one folder that it changes; the function gets a
Path for each; `Shared(value)` is a value that goes to each worker once. On this machine the
path is that of the file itself. On a cluster no disk is shared: files travel by hash, once to each
machine, and what has changed in a `Worked` folder comes back when the task has succeeded, in the
order in which it was written.

Resuming is the caller's: leave out the tasks whose result is there. `done` may return further tasks
(shards that come out of a preparation). Errors: a task that fails is handed to `done` and listed in
the summary, the rest go on; one whose worker is lost is begun again, three times at most; a full
disk here, a lost head and another version of realsim end the run with a sentence; Ctrl-C raises
KeyboardInterrupt with one. Commands take the pool from the two options of
`realsim.app.options.many`, `--workers N` and `--address HOST:PORT|local`.
"""

from realsim.many.carried import Sent, Shared, Worked
from realsim.many.pool import (
    ClusterLostError,
    ForeignNodeError,
    Pool,
    PoolConfig,
    WorkerDiedError,
    Workers,
    at_most,
)
from realsim.many.run import Outcome, Summary, Task, open_pool, run_many

__all__ = [
    "ClusterLostError",
    "ForeignNodeError",
    "Outcome",
    "Pool",
    "PoolConfig",
    "Sent",
    "Shared",
    "Summary",
    "Task",
    "Worked",
    "WorkerDiedError",
    "Workers",
    "at_most",
    "open_pool",
    "run_many",
]
