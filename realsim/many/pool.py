"""A pool does jobs: processes of this machine, or the cores of a Ray cluster."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any, Protocol

from realsim.errors import InputError, RealsimError

LOCAL_CLUSTER = "local"
"""Address that starts a Ray cluster of this machine alone."""


class WorkerDiedError(RealsimError):
    """A worker ended before its job did: killed, out of memory, its machine lost or full."""


class ClusterLostError(RealsimError):
    """The cluster's head is gone, or this machine's node: no job can be handed out any more."""


class ForeignNodeError(InputError):
    """A machine of the cluster has another version of realsim, or none."""


class Pool(Protocol):
    """Does jobs. One that is lost with its worker ends in a `WorkerDiedError`."""

    shares_files: bool
    """Whether a path of this process leads to the same file where the jobs run."""

    def capacity(self) -> int:
        """Return how many jobs may be under way at once; it may change."""
        ...

    def submit(self, fn: Callable[..., Any], /, *args: Any) -> Future[Any]:
        """Start a job; never called with more than `capacity` of them under way.

        Args:
            fn: a function of a module, so that another process finds it by its name.
            args: what can be pickled; a `Sent` or a `Worked` in it becomes a Path.
        """
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class PoolConfig:
    """Where jobs run."""

    workers: int | None = None
    """Processes, or workers of a cluster that is started here; None = one a core. A cluster that is
    joined has its own."""
    address: str = ""
    """HOST:PORT of a Ray cluster's head, as `ray start` told it; `local` starts one of this machine
    alone, on loopback with a token of its own; '' = processes of this machine, without Ray."""

    @property
    def processes(self) -> int:
        """How many workers there are at least, as far as that is known beforehand."""
        from realsim.interop import cores

        return cores() if self.workers is None else self.workers


Workers = PoolConfig | int | None
"""Where jobs run: a number = so many processes, 1 = this one; None = one a core."""


def at_most(where: Workers, jobs: int) -> PoolConfig:
    """Return where jobs run, with no more workers than there are jobs."""
    config = where if isinstance(where, PoolConfig) else PoolConfig(workers=where)
    return replace(config, workers=max(1, min(config.processes, jobs)))
