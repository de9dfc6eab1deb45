"""A Ray cluster of two nodes on loopback loses one, or its head, while a command runs on it.

The command is `realsim generate`: its scenes are made on the nodes and come back as files. The
nodes are started by this file as a program, for Ray reads its variables when it is imported:

    python ray_on_loopback.py       -> the address; then, for every line `node` or `head`, `lost`
"""

import hashlib
import os
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from unittest import mock

from file_trees import bytes_of
from typed_commands import realsim

SCENES = 4
GENERATE = ("--views", "1", "--objects", "1", "--size", "64x48", "--hull-only", "--no-maps",
            "--scenes", str(SCENES))  # fmt: skip
ONE_NODE = {"num_cpus": 1, "object_store_memory": 80_000_000, "include_log_monitor": False}
VARIABLES = {
    "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "t" * 64, "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
}  # fmt: skip


@contextmanager
def two_nodes():
    """Yield the nodes' address, and what loses `node` or `head`."""
    with (
        mock.patch.dict(os.environ, VARIABLES),
        subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as program,
    ):

        def lose(what):
            program.stdin.write(f"{what}\n")
            program.stdin.flush()
            assert program.stdout.readline() == "lost\n"

        yield program.stdout.readline().strip(), lose
        program.stdin.close()


def _serve():
    """Start the nodes, whose every port is on loopback, and lose what the lines say."""
    from ray.cluster_utils import Cluster

    head = {**ONE_NODE, "include_dashboard": False, "no_monitor": True}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    other = cluster.add_node(**ONE_NODE)
    print(cluster.address, flush=True)
    for line in sys.stdin:
        cluster.remove_node(other if line == "node\n" else cluster.head_node, allow_graceful=False)
        print("lost", flush=True)


def listening_beyond_loopback(address):
    """Return whether anything answers at the cluster's port on another address of this machine."""
    port = int(address.rpartition(":")[2])
    others = {i[4][0] for i in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    found = False
    for host in others - {"127.0.0.1"}:
        with socket.socket() as probe:
            probe.settimeout(2)
            found |= not host.startswith("127.") and probe.connect_ex((host, port)) == 0
    return found


def generated(out):
    """Make the scenes on this machine; return what the command said, and the scenes."""
    return realsim("generate", out, *GENERATE, "--workers", "1"), digests(out)


def generated_with_a_loss(out, cluster, what):
    """Make the scenes on the nodes, of which `what` is lost after the first scene.

    Returns:
        How many scenes were there when it was lost, what the command said, and the scenes.
    """
    address, lose = cluster
    at, is_over = [], threading.Event()

    def lose_after_one():
        while not (finished(out) or is_over.is_set()):
            time.sleep(0.02)
        lose(what)
        at.append(finished(out))

    watch = threading.Thread(target=lose_after_one)
    watch.start()
    try:
        said = realsim("generate", out, *GENERATE, "--address", address)
    finally:
        is_over.set()
        watch.join()
    return at[0], said, digests(out)


def finished(out):
    """Return how many scenes are there."""
    return len(list(out.glob("layouts/*.finished.json")))


def digests(out):
    """Return the hashes of what a scene is; its costs and dates differ from run to run."""
    kinds = ("rgb/*.png", "depth/*.png", "mask*/*.png", "annotations/*.json", "models/*.ply")
    found = bytes_of(out, *(f"scene_*/{kind}" for kind in kinds))
    return {name: hashlib.sha256(data).hexdigest() for name, data in found.items()}


if __name__ == "__main__":
    _serve()
