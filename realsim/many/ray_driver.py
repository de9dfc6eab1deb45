"""The process that speaks to Ray, run as a program beside the one that asks.

Where a cluster's head is lost, Ray ends the process that is connected to it, without a word that a
user would understand. So that is this one, which has nothing to lose; the one that asked reads the
end of the connection and says in its own words what is kept. It also keeps Ray's variables, threads
and signal handlers out of that process, and its output out of the terminal.

Messages are pickled tuples. From the one that asks: ("open", Opening), then ("job", number, bytes,
{address: path}, whether files come back), and at last ("close",). To it: ("open", address,
capacity), ("refused", error), ("capacity", count), and of a job ("piece", number, bytes), ("ended",
number, bytes), ("lost", number, text), ("foreign", number, text), ("broken", number, text).
"""

import contextlib
import os
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from realsim.errors import InputError

TOKEN_SOURCES = ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")
TOKEN_FILE = Path(".ray/auth_token")
"""In the home folder: where Ray looks if no variable says otherwise."""
LOOPBACK_ONLY = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
"""Makes Ray take 127.0.0.1 for the machine's address, so that every port is on loopback alone; it
does so by itself only on systems whose firewall would ask."""
ALWAYS = {
    "RAY_AUTH_MODE": "token",
    "RAY_USAGE_STATS_ENABLED": "0",
    # Or Ray starts its workers through `uv run` if the command was, which may install packages.
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
}
"""Set before Ray is imported: it reads most of it then."""
QUIET = {"log_to_driver": False, "logging_level": "ERROR"}
STRANGER = """
import sys, ray
ray.init(address=sys.argv[1], log_to_driver=False, logging_level="CRITICAL")
"""
"""Succeeds where a cluster lets in who has no token."""
AS_STRANGER = {"RAY_AUTH_MODE": "disabled", "RAY_NUM_REDIS_GET_RETRIES": "3"}
"""Ray asks twenty times, once a second, though a cluster says at once that it lets nobody in."""
OBJECT_STORE_BYTES = 200_000_000
"""Memory for jobs and results of a cluster that is started here; what is more goes to the disk."""
PIECES_AHEAD = 4
"""Pieces of a job's files that wait to be taken; the job waits for the next."""
ANSWER_S = 5.0
"""Longest wait for the head node's answer [s]."""
STRANGER_S = 30.0
"""Longest wait for the stranger [s]; a cluster that says nothing has not let it in."""
COUNT_AGAIN_S = 5.0
"""How often the cluster's cores are counted [s]."""
FORGET_S = 10.0
"""Longest wait for the machines to remove what they keep of a run [s]."""


@dataclass(frozen=True, slots=True)
class Opening:
    """Which cluster, and which run."""

    address: str
    """HOST:PORT; '' = one is started on this machine."""
    workers: int
    """Number of workers of a cluster that is started."""
    run: str
    """Names the folder where machines keep this run's files."""
    paths: tuple[str, ...]
    """Where the one who asks looks for modules: a machine looks there, too."""


# --- the cluster ----------------------------------------------------------------------------------


def require_address(address: str) -> tuple[str, int]:
    """Return host and port of a cluster that may be joined.

    Raises:
        InputError: it is no address, nobody's, or this machine has no token to show.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or "/" in address:
        raise InputError(
            f"'{address}' is no address of a Ray cluster; HOST:PORT of its head node is accepted, "
            "as `ray start --head` told it, such as 192.168.0.10:6379, or `local`."
        )
    try:
        socket.getaddrinfo(host, int(port))
    except OSError as error:
        raise InputError(
            f"'{address}': no machine of the name '{host}' is known here ({error.strerror}); give "
            "the name or number that `ray start --head` told."
        ) from error
    has_token = any(os.environ.get(name) for name in TOKEN_SOURCES)
    has_token = has_token or (Path.home() / TOKEN_FILE).is_file()
    if os.environ.get("RAY_AUTH_MODE", "token").lower() != "token" or not has_token:
        raise InputError(
            f"there is no token for the Ray cluster at {address}, and without one whoever reaches "
            "a cluster runs any code on its machines. Set RAY_AUTH_MODE=token on all machines, "
            "make a token with `ray get-auth-token --generate`, copy ~/.ray/auth_token to all of "
            "them and start the cluster again."
        )
    return host, int(port)


def _import_ray() -> Any:
    """Return the module, ready to show a token and to tell nobody of its use."""
    os.environ.update(ALWAYS)
    ray: Any = import_module("ray")
    import_module("ray.exceptions")
    return ray


def _start(opening: Opening, stack: contextlib.ExitStack) -> Any:
    """Start a cluster of this machine on loopback, with a token of its own."""
    os.environ.update(LOOPBACK_ONLY)
    os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    # Short: the names of its sockets have 107 characters at most.
    folder = tempfile.mkdtemp(prefix="rs_ray_", dir="/tmp")
    stack.callback(shutil.rmtree, folder, ignore_errors=True)
    ray = _import_ray()
    ray.init(
        address="local", num_cpus=opening.workers, num_gpus=0, _temp_dir=folder,
        object_store_memory=OBJECT_STORE_BYTES, include_dashboard=False,
        dashboard_host="127.0.0.1", **QUIET,
    )  # fmt: skip
    return ray


def _join(address: str) -> Any:
    """Connect to a cluster that is running and asks for a token."""
    host, port = require_address(address)
    ray = _import_ray()
    try:
        # Ray itself looks for minutes for one that is not there.
        socket.create_connection((host, port), ANSWER_S).close()
        ray.init(address=address, **QUIET)
    except (OSError, RuntimeError, ValueError, OverflowError, ray.exceptions.RayError) as error:
        raise InputError(
            f"the Ray cluster at {address} cannot be joined: {_first_line(error)} Check that it is "
            "running (`ray status`), that this machine is one of its nodes (`ray start "
            f"--address={address}`), and that its token is this machine's."
        ) from error
    if _lets_strangers_in(address):
        raise InputError(
            f"the Ray cluster at {address} lets in anyone without a token: whoever reaches it runs "
            "any code on its machines. Start it again with RAY_AUTH_MODE=token on all of them."
        )
    return ray


def _lets_strangers_in(address: str) -> bool:
    """Return whether a process without a token can connect."""
    hidden = {name: value for name, value in os.environ.items() if name not in TOKEN_SOURCES}
    try:
        done = subprocess.run(
            [sys.executable, "-c", STRANGER, address],
            env=hidden | AS_STRANGER, capture_output=True, timeout=STRANGER_S, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def _first_line(error: BaseException) -> str:
    """Return an error's first line."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


# --- on a node; these two are sent as they are, for a machine may have no such module -------------


def on_node(
    own_version: str, run: str, paths: tuple[str, ...], job: bytes, files: dict[str, list[Any]]
) -> Iterator[Any]:
    """Do a job on a machine: yield its pieces and its end as bytes, or a text if it is foreign."""
    import socket
    from importlib.metadata import PackageNotFoundError, version

    try:
        found = version("realsim")
    except PackageNotFoundError:
        found = ""
    if found != own_version:
        has = f"realsim {found}" if found else "no realsim"
        yield f"the machine {socket.gethostname()} has {has}, this one {own_version}"
        return
    import sys

    import ray

    from realsim.many.ray_node import work

    sys.path.extend(path for path in paths if path not in sys.path)

    def fetch(digest: str) -> bytes:
        # In a list, for Ray would send what stands alone whether it is needed or not.
        found: bytes = ray.get(files[digest][0])  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
        return found  # pyright: ignore[reportUnknownVariableType]

    yield from work(run, job, fetch)


def on_node_forget(run: str) -> None:
    """Remove what a machine keeps of a run."""
    from realsim.many.ray_node import forget

    forget(run)


# --- this process ---------------------------------------------------------------------------------


class Driver:
    """Hands jobs to Ray, each watched by a thread, and passes on what becomes of them."""

    def __init__(self, ray: Any, connection: Connection, opening: Opening) -> None:
        """Take the connected Ray."""
        self._ray, self._connection, self._opening = ray, connection, opening
        self._sending = threading.Lock()
        self._files: dict[str, Any] = {}
        self._users: dict[str, int] = {}
        self._counting = threading.Lock()
        # Ray would try again by itself; the one who asks does, and gives up what kills its workers.
        self._task = ray.remote(
            num_cpus=1, max_retries=0, scheduling_strategy="SPREAD", num_returns="streaming",
            _generator_backpressure_num_objects=PIECES_AHEAD,
        )(on_node)  # fmt: skip
        self._lost = (
            ray.exceptions.WorkerCrashedError,
            ray.exceptions.NodeDiedError,
            ray.exceptions.LocalRayletDiedError,
            ray.exceptions.OutOfMemoryError,
            ray.exceptions.ObjectLostError,
        )

    def send(self, *message: Any) -> None:
        """Tell the one who asked; if it is gone there is nothing left to do."""
        with self._sending:
            try:
                self._connection.send(message)
            except OSError:
                os._exit(0)

    def serve(self) -> None:
        """Take jobs until the one who asks hangs up."""
        address = self._ray.get_runtime_context().gcs_address
        self.send("open", address, self._capacity())
        threading.Thread(target=self._count, daemon=True).start()
        while True:
            try:
                kind, *told = self._connection.recv()
            except EOFError:
                return
            if kind == "close":
                return
            number, job, files, comes_back = told
            refs = {digest: [self._kept(digest, source)] for digest, source in files.items()}
            found = self._task.remote(
                version("realsim"), self._opening.run, self._opening.paths, job, refs
            )
            threading.Thread(
                target=self._watch, args=(number, found, tuple(files), comes_back), daemon=True
            ).start()

    def _kept(self, digest: str, source: Path) -> Any:
        """Return Ray's handle of a file; it is kept as long as a job under way needs it."""
        with self._counting:
            self._users[digest] = self._users.get(digest, 0) + 1
            if digest not in self._files:
                self._files[digest] = self._ray.put(source.read_bytes())
            return self._files[digest]

    def _dropped(self, digests: tuple[str, ...]) -> None:
        """Forget files that no job under way needs."""
        with self._counting:
            for digest in digests:
                self._users[digest] -= 1
                if self._users[digest] == 0:
                    del self._users[digest], self._files[digest]

    def _watch(self, number: int, found: Any, digests: tuple[str, ...], comes_back: bool) -> None:
        """Pass on what comes of a job."""
        last: Any = None
        try:
            for ref in found:
                if comes_back and last is not None:
                    self.send("piece", number, last)
                last = self._ray.get(ref)
        except self._lost as error:
            self.send("lost", number, f"its Ray worker was lost: {_first_line(error)}")
        except Exception as error:
            self.send("broken", number, f"{type(error).__name__}: {error}")
        else:
            kind = "foreign" if isinstance(last, str) else "ended"
            self.send(kind, number, last)
        finally:
            self._dropped(digests)

    def _capacity(self) -> int:
        """Return the cluster's cores, and one job more a node that waits there for a core."""
        alive = [node for node in self._ray.nodes() if node["Alive"]]
        return sum(int(node["Resources"].get("CPU", 0)) for node in alive) + len(alive)

    def _count(self) -> None:
        """Tell now and then how many cores there are."""
        while True:
            time.sleep(COUNT_AGAIN_S)
            self.send("capacity", self._capacity())

    def forget(self) -> None:
        """Let every machine remove what it keeps of this run; one that does not answer is left."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        forget = self._ray.remote(num_cpus=0, max_retries=0)(on_node_forget)
        asked = [
            forget.options(
                scheduling_strategy=NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            ).remote(self._opening.run)
            for node in self._ray.nodes()
            if node["Alive"]
        ]
        self._ray.wait(asked, num_returns=len(asked), timeout=FORGET_S)


def main(handle: int) -> None:
    """Connect to the cluster, and serve."""
    connection = Connection(handle)
    _, opening = connection.recv()
    with contextlib.ExitStack() as stack:
        try:
            ray = _join(opening.address) if opening.address else _start(opening, stack)
        except Exception as error:
            told = error if isinstance(error, InputError) else InputError(
                f"Ray could not be started: {_first_line(error)}"
            )  # fmt: skip
            connection.send(("refused", told))
            return
        stack.callback(ray.shutdown)
        driver = Driver(ray, connection, opening)
        driver.serve()
        with contextlib.suppress(Exception):
            driver.forget()


if __name__ == "__main__":
    main(int(sys.argv[1]))
