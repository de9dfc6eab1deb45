"""The cores of a Ray cluster as a pool: one of this machine on loopback, or machines joined.

To join machines, with realsim[cluster] installed on each in the same version:

    export RAY_AUTH_MODE=token                # on every machine
    ray get-auth-token --generate             # once; copy ~/.ray/auth_token to the others
    ray start --head --include-dashboard=false --disable-usage-stats     # on the first
    ray start --address=FIRST:6379                                       # on the others

and run on one of them with `PoolConfig(address="FIRST:6379")`. Whoever reaches a Ray cluster runs
any code on its machines; without a token it is refused here. Jobs carry all they need and their
results come back to the process that asked, so no folder needs to be shared. What a Ray worker does
is what a local process does: the results are the same where the machines are alike (another CPU may
round the last bit otherwise).

Ray itself is spoken to by a process of its own (`ray_driver`).
"""

import pickle
import secrets
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.interop import offer
from realsim.many.carried import Incoming, packed
from realsim.many.pool import (
    LOCAL_CLUSTER,
    ClusterLostError,
    ForeignNodeError,
    Pool,
    PoolConfig,
    WorkerDiedError,
)
from realsim.many.ray_driver import Opening, require_address
from realsim.many.ray_node import Ended
from realsim.store.atomic import only_run_in

OPEN_S = 120.0
"""Longest wait until the cluster is there [s]."""
END_S = 30.0
"""Longest wait until it has been left [s]."""
KNOCK_S = 2.0
"""How often the head is asked whether it is there [s]."""
KNOCKS = 4
"""Times in a row that it does not answer before it counts as lost."""


@contextmanager
def ray_pool(config: PoolConfig) -> Generator[Pool]:
    """Yield the workers of a cluster; leaving disconnects from it, or ends one that was started.

    Raises:
        InputError: Ray is not installed, the cluster is not there, or it lets in anyone.
    """
    opening = Opening(
        address="" if config.address == LOCAL_CLUSTER else config.address,
        workers=config.processes, run=secrets.token_hex(8),
        paths=tuple(path for path in sys.path if path),
    )  # fmt: skip
    if opening.address:
        require_address(opening.address)
    _require_ray()
    own, others = Pipe()
    with ExitStack() as stack:
        log = stack.enter_context(tempfile.TemporaryFile(prefix="realsim_ray_"))
        # In a session of its own: Ctrl-C in the terminal is for the one who asks.
        process = subprocess.Popen(
            [sys.executable, "-m", "realsim.many.ray_driver", str(others.fileno())],
            pass_fds=(others.fileno(),), stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            start_new_session=True,
        )  # fmt: skip
        others.close()
        kept = stack.enter_context(tempfile.TemporaryDirectory(prefix="realsim_many_"))
        pool = _RayPool(own, process, config.address, Path(kept))
        stack.callback(pool.end)
        pool.open(opening)
        yield pool


def _require_ray() -> None:
    """Raise if Ray is not installed."""
    try:
        is_there = find_spec("ray") is not None
    except ValueError:  # something put None in its place
        is_there = False
    if not is_there:
        raise InputError(
            "Ray is not installed; it runs work on more machines than one. "
            f"{offer('cluster')}, or leave out --address: the cores of this machine are used "
            "without it."
        )


@dataclass(eq=False, slots=True)
class _UnderWay:
    """A job on the cluster."""

    future: Future[Any]
    stack: ExitStack
    """Holds the folder that it changes."""
    incoming: Incoming | None


class _RayPool:
    """What is under way on the cluster; a thread takes what the driver tells."""

    shares_files = False

    def __init__(
        self, connection: Connection, process: subprocess.Popen[bytes], name: str, kept: Path
    ) -> None:
        self._connection, self._process, self._name = connection, process, name
        self._kept = kept
        self._jobs: dict[int, _UnderWay] = {}
        self._lock = threading.Lock()
        self._next, self._capacity, self._is_lost, self._ends = 0, 0, False, False

    def open(self, opening: Opening) -> None:
        """Wait until the cluster is there."""
        self._connection.send(("open", opening))
        try:
            answer = self._connection.recv() if self._connection.poll(OPEN_S) else None
        except EOFError:
            answer = None
        if answer is None:
            raise InputError(
                f"the Ray cluster ({self._name}) did not answer. Look with `ray status` whether it "
                "is there, or leave out --address: the cores of this machine are used without it."
            )
        if answer[0] == "refused":
            raise answer[1]
        _, address, self._capacity = answer
        threading.Thread(target=self._listen, daemon=True).start()
        threading.Thread(target=self._knock, args=(address,), daemon=True).start()

    def capacity(self) -> int:
        """Return the cluster's cores, and one job more a node that waits there for a core."""
        return self._capacity

    def submit(self, fn: Callable[..., Any], /, *args: Any) -> Future[Any]:
        """Start a job; no more than `capacity` should be under way."""
        future: Future[Any] = Future()
        stack = ExitStack()
        try:
            incoming: Incoming | None = None
            wire, files, worked = packed(args, self._kept)
            for item in worked:
                item.folder.mkdir(parents=True, exist_ok=True)
                if not item.only:
                    stack.enter_context(only_run_in(item.folder))
                incoming = Incoming(item.folder)
                stack.callback(incoming.drop)
            job = pickle.dumps((fn, wire))
        except Exception as error:
            stack.close()
            future.set_exception(error)
            return future
        under_way = _UnderWay(future, stack, incoming)
        with self._lock:
            number, self._next = self._next, self._next + 1
            if self._is_lost:
                self._settle(under_way, self._loss())
                return future
            self._jobs[number] = under_way
        try:
            self._connection.send(("job", number, job, files, incoming is not None))
        except OSError:
            self._lose()
        return future

    def end(self) -> None:
        """Hang up: the driver leaves the cluster, which ends the jobs under way."""
        self._ends = True
        try:
            with suppress(OSError):
                self._connection.send(("close",))
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._connection.close()

    # --- threads of this process ------------------------------------------------------------------

    def _listen(self) -> None:
        """Take what the driver tells until it is gone."""
        while True:
            try:
                kind, *told = self._connection.recv()
            except (EOFError, OSError, TypeError):
                self._lose()
                return
            if kind == "capacity":
                self._capacity = told[0]
                continue
            number, data = told
            if kind == "piece":
                self._keep(number, data)
                continue
            with self._lock:
                job = self._jobs.pop(number, None)
            if job is not None:
                self._settle(job, _ending(kind, data))

    def _keep(self, number: int, data: bytes) -> None:
        """Keep a piece of a file that comes back; if that fails, the job has failed."""
        job = self._jobs.get(number)
        if job is None or job.incoming is None:
            return
        try:
            job.incoming.take(pickle.loads(data))
        except Exception as error:
            with self._lock:
                self._jobs.pop(number, None)
            self._settle(job, error)

    def _settle(self, job: _UnderWay, ended: Ended | Exception) -> None:
        """Pass on how a job ended; what it changed is there before."""
        error = ended if isinstance(ended, Exception) else ended.error
        try:
            if not isinstance(ended, Exception) and error is None and job.incoming is not None:
                job.incoming.commit(ended.removed)
        except Exception as failed:
            error = failed
        job.stack.close()
        if error is None and isinstance(ended, Ended):
            job.future.set_result(ended.value)
        else:
            job.future.set_exception(error)

    def _knock(self, address: str) -> None:
        """Ask now and then whether the head is there; Ray itself would wait for a minute."""
        host, _, port = address.rpartition(":")
        missed = 0
        while not self._ends and not self._is_lost:
            time.sleep(KNOCK_S)
            try:
                socket.create_connection((host, int(port)), KNOCK_S).close()
                missed = 0
            except OSError:
                missed += 1
            if missed == KNOCKS and not self._ends:
                self._process.kill()
                self._lose()

    def _lose(self) -> None:
        """Let every job end: nothing is heard of them any more."""
        with self._lock:
            self._is_lost = True
            jobs, self._jobs = list(self._jobs.values()), {}
        for job in jobs:
            self._settle(job, self._loss())

    def _loss(self) -> ClusterLostError:
        """Return what is said of the lost cluster."""
        return ClusterLostError(f"the Ray cluster ({self._name}) is lost: its head is gone.")


def _ending(kind: str, data: Any) -> Ended | Exception:
    """Return how a job ended by what the driver tells."""
    if kind == "lost":
        return WorkerDiedError(data)
    if kind == "foreign":
        return ForeignNodeError(
            f"{data}; results are not mixed. Install the same version on all machines."
        )
    if kind == "broken":
        return RuntimeError(data)
    ended: Ended = pickle.loads(data)
    return WorkerDiedError(ended.full) if ended.full else ended
