"""The school's jobs on a Ray cluster: a local one on loopback, or machines that a user joined.

To join machines, with realsim[cluster] installed on each in the same version:

    export RAY_AUTH_MODE=token                # on every machine
    ray get-auth-token --generate             # once; copy ~/.ray/auth_token to the others
    ray start --head --include-dashboard=false --disable-usage-stats     # on the first
    ray start --address=FIRST:6379                                       # on the others

and run the school on one of them with `ClusterConfig(address="FIRST:6379")`. Whoever reaches a Ray
cluster runs any code on its machines; without a token it is refused here. Jobs carry all they need
and their results come back to the process that asked, so no folder needs to be shared. What a Ray
worker does is what a local process does: the results are the same where the machines are alike
(another CPU may round the last bit otherwise).
"""

import functools
import os
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

from realsim.errors import InputError
from realsim.interop import cores
from realsim_sim_bridge.school.workers import WorkerDiedError, Workers

TOKEN_SOURCES = ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")
TOKEN_FILE = Path(".ray/auth_token")
"""In the home folder: where Ray looks if no variable says otherwise."""
LOOPBACK_ONLY = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
"""Makes Ray take 127.0.0.1 for the machine's address, so that every port is on loopback alone; it
does so by itself only on systems whose firewall would ask."""
ALWAYS = {
    "RAY_AUTH_MODE": "token",
    "RAY_USAGE_STATS_ENABLED": "0",
    # Or Ray starts its workers through `uv run` if the school was, which installs from the network.
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
}
"""Set before Ray is imported: it reads most of it then."""
QUIET = {"log_to_driver": False, "logging_level": "ERROR"}
STRANGER = """
import sys, ray
ray.init(address=sys.argv[1], log_to_driver=False, logging_level="CRITICAL")
"""
"""Succeeds where a cluster lets in who has no token."""
ANSWER_S = 5.0
"""Longest wait for the head node's answer [s]."""
STRANGER_S = 30.0
"""Longest wait for the stranger [s]; a cluster that says nothing has not let it in."""
COUNT_AGAIN_S = 5.0
"""How often the cluster's cores are counted [s]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ClusterConfig:
    """Which Ray cluster."""

    address: str | None = None
    """HOST:PORT of the head node, as `ray start` told it; None = a cluster of this machine alone,
    started on loopback with a token of its own, and ended with the run."""
    workers: int | None = None
    """Workers of a cluster that is started; None = one a core."""
    object_store_bytes: int = 100_000_000
    """Memory for jobs and results of a cluster that is started [bytes]: a job has some MB."""


@contextmanager
def ray_workers(config: ClusterConfig) -> Generator[Workers]:
    """Yield the workers of a cluster; leaving disconnects from it, or ends one that was started.

    Raises:
        InputError: Ray is not installed, the cluster is not there, or it lets in anyone.
    """
    with _environment_restored():
        ray = _start(config) if config.address is None else _join(config.address)
        try:
            yield _RayWorkers(ray)
        finally:
            ray.shutdown()


@contextmanager
def _environment_restored() -> Generator[None]:
    """Undo what is set for Ray, and its own answer to SIGTERM."""
    before = dict(os.environ)
    in_main = threading.current_thread() is threading.main_thread()
    on_sigterm = signal.getsignal(signal.SIGTERM) if in_main else None
    try:
        yield
    finally:
        for name in set(os.environ) - set(before):
            del os.environ[name]
        os.environ.update(before)
        if on_sigterm is not None:
            signal.signal(signal.SIGTERM, on_sigterm)


def _start(config: ClusterConfig) -> Any:
    """Start a cluster of this machine on loopback, with a token of its own."""
    os.environ.update(LOOPBACK_ONLY)
    os.environ["RAY_AUTH_TOKEN"] = _own_token()
    ray = _import_ray(loopback=True)
    ray.init(
        address="local",
        num_cpus=cores() if config.workers is None else config.workers,
        num_gpus=0,
        object_store_memory=config.object_store_bytes,
        include_dashboard=False,
        dashboard_host="127.0.0.1",
        **QUIET,
    )
    return ray


@functools.cache
def _own_token() -> str:
    """Return this process's token: 256 random bits."""
    return secrets.token_hex(32)


def _join(address: str) -> Any:
    """Connect to a cluster that is running and asks for a token."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or "/" in address:
        raise InputError(
            f"'{address}' is no address of a Ray cluster; HOST:PORT of its head node is accepted, "
            "as `ray start --head` told it, such as 192.168.0.10:6379."
        )
    if os.environ.get("RAY_AUTH_MODE", "token").lower() != "token" or not _has_token():
        raise InputError(
            f"there is no token for the Ray cluster at {address}, and without one whoever reaches "
            "a cluster runs any code on its machines. Set RAY_AUTH_MODE=token on all machines, "
            "make a token with `ray get-auth-token --generate`, copy ~/.ray/auth_token to all of "
            "them and start the cluster again."
        )
    ray = _import_ray(loopback=False)
    try:
        # Ray itself looks for minutes for one that is not there.
        socket.create_connection((host, int(port)), ANSWER_S).close()
        ray.init(address=address, **QUIET)
    except (OSError, RuntimeError, ValueError, OverflowError, ray.exceptions.RayError) as error:
        raise InputError(
            f"the Ray cluster at {address} cannot be joined: {_first_line(error)} Check that it is "
            "running (`ray status`), that this machine is one of its nodes (`ray start "
            f"--address={address}`), and that its token is this machine's."
        ) from error
    if _lets_strangers_in(address):
        ray.shutdown()
        raise InputError(
            f"the Ray cluster at {address} lets in anyone without a token: whoever reaches it runs "
            "any code on its machines. Start it again with RAY_AUTH_MODE=token on all of them."
        )
    return ray


def _has_token() -> bool:
    """Return whether Ray finds a token."""
    named = any(os.environ.get(name) for name in TOKEN_SOURCES)
    return named or (Path.home() / TOKEN_FILE).is_file()


def _import_ray(*, loopback: bool) -> Any:
    """Return the module, ready to show a token and to tell nobody of its use."""
    os.environ |= ALWAYS
    try:
        ray: Any = import_module("ray")
        import_module("ray.exceptions")
    except ImportError:
        raise InputError(
            "Ray is not installed; it runs the Robot School on more machines than one. Install it "
            "with `uv sync --extra cluster` or `pip install 'realsim[cluster]'`, or leave out the "
            "cluster: the cores of this machine are used without it."
        ) from None
    if ray.is_initialized():
        raise InputError(
            "this process is connected to a Ray cluster already. Call ray.shutdown() first, or run "
            "the Robot School in a process of its own."
        )
    constants = ray._private.ray_constants
    by_uv = constants.RAY_ENABLE_UV_RUN_RUNTIME_ENV
    if by_uv or (loopback and constants.ENABLE_RAY_CLUSTER):
        raise InputError(
            "Ray was imported in this process before the Robot School could tell it how to start. "
            "Run the Robot School in a process of its own."
        )
    # Ray remembers the first token it was asked for.
    ray._raylet.AuthenticationTokenLoader.instance().reset_cache()
    return ray


def _lets_strangers_in(address: str) -> bool:
    """Return whether a process without a token can connect."""
    hidden = {name: value for name, value in os.environ.items() if name not in TOKEN_SOURCES}
    try:
        done = subprocess.run(
            [sys.executable, "-c", STRANGER, address],
            env=hidden | {"RAY_AUTH_MODE": "disabled"},
            capture_output=True,
            timeout=STRANGER_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def _first_line(error: BaseException) -> str:
    """Return an error's first line."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


class _RayWorkers:
    """The cores of a cluster; a job is a Ray task."""

    shares_files = False

    def __init__(self, ray: Any) -> None:
        self._ray = ray
        # Ray would try again by itself; the day does, and gives up a job that kills its workers.
        self._task = ray.remote(num_cpus=1, max_retries=0, scheduling_strategy="SPREAD")(_on_node)
        self._counted_at, self._capacity = -float("inf"), 0
        self._lost = (
            ray.exceptions.WorkerCrashedError,
            ray.exceptions.NodeDiedError,
            ray.exceptions.LocalRayletDiedError,
            ray.exceptions.OutOfMemoryError,
            ray.exceptions.ObjectLostError,
        )

    def capacity(self) -> int:
        """Return the cluster's cores, and one job more a node that waits there for a core."""
        if time.monotonic() - self._counted_at > COUNT_AGAIN_S:
            alive = [node for node in self._ray.nodes() if node["Alive"]]
            count = sum(int(node["Resources"].get("CPU", 0)) for node in alive)
            self._capacity, self._counted_at = count + len(alive), time.monotonic()
        return self._capacity

    def submit(self, fn: Callable[..., Any], /, *args: Any) -> Future[Any]:
        """Start a task; no more than `capacity` should be under way."""
        outer: Future[Any] = Future()
        found = self._task.remote(version("realsim"), fn, args)
        found.future().add_done_callback(partial(self._settle, outer))
        return outer

    def _settle(self, outer: Future[Any], inner: Future[Any]) -> None:
        """Pass on what became of a task."""
        error = inner.exception()
        if error is None:
            outer.set_result(inner.result())
        elif isinstance(error, self._lost):
            outer.set_exception(WorkerDiedError(f"its Ray worker was lost: {_first_line(error)}"))
        elif isinstance(error, self._ray.exceptions.RayTaskError):
            outer.set_exception(getattr(error, "cause", None) or error)
        else:
            outer.set_exception(error)


def _on_node(driver_version: str, fn: Callable[..., Any], args: tuple[Any, ...]) -> Any:
    """Do a job on a node of the cluster, with one thread like every worker.

    Raises:
        InputError: the node has another version of realsim.
    """
    from threadpoolctl import threadpool_limits

    if version("realsim") != driver_version:
        raise InputError(
            f"the machine {socket.gethostname()} has realsim {version('realsim')}, this one "
            f"{driver_version}; results are not mixed. Install the same version on all machines."
        )
    with threadpool_limits(1):
        return fn(*args)
