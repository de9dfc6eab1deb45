"""A program: a Ray cluster on loopback loses a node, or its head, while a command runs on it.

    python ray_on_loopback.py node|head FOLDER      -> what came of it, as one JSON line

The command is `realsim generate`: its scenes are made on the nodes and come back as files.
"""

import hashlib
import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

SCENES = 4
GENERATE = ("--views", "2", "--objects", "1-2", "--size", "160x120", "--hull-only", "--no-maps",
            "--scenes", str(SCENES))  # fmt: skip
ONE_NODE = {"num_cpus": 1, "object_store_memory": 80_000_000}
LONGEST_S = 200


def nodes(count):
    """Start nodes whose every port is on loopback."""
    os.environ.update(RAY_AUTH_MODE="token", RAY_USAGE_STATS_ENABLED="0")
    os.environ.update(RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER="0", RAY_ENABLE_UV_RUN_RUNTIME_ENV="0")
    os.environ["RAY_AUTH_TOKEN"] = "t" * 64
    from ray.cluster_utils import Cluster

    head = {**ONE_NODE, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    return cluster, [cluster.add_node(**ONE_NODE) for _ in range(count - 1)]


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


def generate(out, *more):
    """Start the command."""
    line = "import sys; from realsim.app.cli import main; sys.argv[0] = 'realsim'; main()"
    return subprocess.Popen(
        [sys.executable, "-c", line, "generate", str(out), *GENERATE, *more],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def finished(out):
    """Return how many scenes are there."""
    return len(list(out.glob("layouts/*.finished.json")))


def wait_for_one(process, out):
    """Wait until the first scene is there, or the command has ended."""
    begun = time.monotonic()
    while not finished(out) and process.poll() is None and time.monotonic() - begun < LONGEST_S:
        time.sleep(0.05)


def digests(out):
    """Return the hashes of what a scene is; its costs and dates differ from run to run."""
    kinds = ("rgb/*.png", "depth/*.png", "mask/*.png", "mask_visib/*.png", "annotations/*.json",
             "models/*.ply")  # fmt: skip
    return {
        p.relative_to(out).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for kind in kinds
        for p in sorted(out.glob(f"scene_*/{kind}"))
    }


def lose(what, folder):
    """Lose a node, or the head, after the first scene; return what came of the command."""
    cluster, others = nodes(2 if what == "node" else 1)
    out = folder / what
    process = generate(out, "--address", cluster.address)
    wait_for_one(process, out)
    beyond = listening_beyond_loopback(cluster.address)
    lost = others[0] if what == "node" else cluster.head_node
    cluster.remove_node(lost, allow_graceful=False)
    at = finished(out)
    _, told = process.communicate(timeout=LONGEST_S)
    kept = digests(out)
    again, code = "", process.returncode
    if what == "head":
        process = generate(out)
        again = process.communicate(timeout=LONGEST_S)[1]
    else:
        cluster.shutdown()
    whole = generate(folder / "whole")
    whole.communicate(timeout=LONGEST_S)
    expected = digests(folder / "whole")
    return {
        "scenes": SCENES, "finished_when_lost": at, "code": code, "told": told, "again": again,
        "again_code": process.returncode, "same": digests(out) == expected and bool(expected),
        "kept_same": all(expected.get(name) == digest for name, digest in kept.items()),
        "kept": len(kept), "beyond_loopback": beyond,
        "leftovers": [str(p) for p in out.rglob("*.part")],
    }  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(lose(sys.argv[1], Path(sys.argv[2]))), flush=True)
