"""A program: two Ray nodes on loopback, of which one is killed in the middle of the school.

It prints what came of it as one JSON line.
"""

import json
import os
import socket
import threading

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


def nodes(count):
    """Start nodes whose every port is on loopback."""
    os.environ.update(RAY_AUTH_MODE="token", RAY_USAGE_STATS_ENABLED="0")
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
    cluster, (other,) = nodes(2)
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


if __name__ == "__main__":
    print(json.dumps(two_nodes()), flush=True)
