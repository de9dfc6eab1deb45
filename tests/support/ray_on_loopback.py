"""A program: Ray nodes on loopback, and the school on them; prints one JSON line.

python ray_on_loopback.py two-nodes     one of two nodes is killed in the middle of the school
python ray_on_loopback.py started       the school starts a cluster of this machine itself
python ray_on_loopback.py open          a node without a token, held until the input ends
python ray_on_loopback.py join ADDRESS  the school on a cluster that runs already
"""

import json
import os
import socket
import sys
import threading

from realsim.errors import InputError
from realsim_sim_bridge.school import ClusterConfig, run_school_results
from school_scenes import at, model, same, same_motion, scene, small_worlds

OBJECTS = scene(at(0, 0), at(0.2, 0.1, instance=1))


def school(workers, progress=None):
    return run_school_results(
        OBJECTS, {1: model()}, small_worlds(), workers=workers, shard_grasps=2, progress=progress
    )


def agree(a, b):
    return all(
        same(x.grasp_set, y.grasp_set) and same_motion(x.trajectories, y.trajectories)
        for x, y in zip(a, b, strict=True)
    )


def nodes(count, mode):
    """Start nodes whose every port is on loopback."""
    os.environ.update(RAY_AUTH_MODE=mode, RAY_USAGE_STATS_ENABLED="0")
    os.environ.update(RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER="0", RAY_ENABLE_UV_RUN_RUNTIME_ENV="0")
    from ray.cluster_utils import Cluster

    one = {"num_cpus": 1, "object_store_memory": 80_000_000}
    cluster = Cluster(initialize_head=True, head_node_args={**one, "include_dashboard": False})
    return cluster, [cluster.add_node(**one) for _ in range(count - 1)]


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


def two_nodes():
    os.environ["RAY_AUTH_TOKEN"] = "t" * 64
    cluster, (other,) = nodes(2, "token")
    killed = []

    def kill_one(done, of):
        if not killed and 4 <= done < of:
            killed.append(done)
            threading.Thread(target=cluster.remove_node, args=(other, False)).start()

    found = school(ClusterConfig(address=cluster.address), kill_one)
    beyond = listening_beyond_loopback(cluster.address)
    cluster.shutdown()
    return {
        "killed": killed,
        "same": agree(found, school(1)),
        "unfinished": [r.unfinished for r in found],
        "beyond_loopback": beyond,
    }


def started():
    before = dict(os.environ)
    seen = {}

    def look(*_):
        import ray

        context = ray.get_runtime_context()
        seen["address"], seen["mode"] = context.gcs_address, os.environ["RAY_AUTH_MODE"]
        seen["beyond_loopback"] = listening_beyond_loopback(context.gcs_address)

    found = school(ClusterConfig(workers=2), look)
    again = school(ClusterConfig(workers=1))
    local = school(1)
    return seen | {
        "same": agree(found, local) and agree(again, local),
        "left_in_environment": sorted(
            name
            for name in {*before, *os.environ}
            if before.get(name) != os.environ.get(name) and name.startswith("RAY")
        ),
    }


def joined(address):
    os.environ.update(RAY_AUTH_TOKEN="t" * 64, RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER="0")
    try:
        school(ClusterConfig(address=address))
    except InputError as error:
        return {"error": str(error)}
    return {"error": ""}


if __name__ == "__main__":
    what = sys.argv[1]
    if what == "open":
        held, _ = nodes(1, "disabled")
        print(json.dumps({"address": held.address}), flush=True)
        sys.stdin.read()
        held.shutdown()
    else:
        jobs = {"two-nodes": two_nodes, "started": started}
        print(json.dumps(joined(sys.argv[2]) if what == "join" else jobs[what]()), flush=True)
