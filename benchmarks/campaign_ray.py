"""Work on two nodes of a Ray cluster: what the second brings, and what losing one costs.

Nodes have one core each, on loopback. How long a run takes is counted in CPU seconds along its
longest way (`school_scaling`), so that others on the machine do not change it:

    ratio = (asking + only node) with one node / (asking + busiest node) with two
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from figures import Found
from school_cases import in_fresh_process
from school_scaling import CountedWorkers, ScalingJob, ray_nodes, runs

from realsim.app.generate.request import GenerateRequest, claim
from realsim.app.generate.run import scene_tasks
from realsim.many import PoolConfig, open_pool, run_many
from realsim_sim_bridge.synthetic.config import SyntheticConfig
from realsim_sim_bridge.table_scenes.cameras import ViewConfig
from realsim_sim_bridge.table_scenes.config import PoolConfig as ObjectPoolConfig
from realsim_sim_bridge.table_scenes.config import TableSceneConfig
from realsim_sim_bridge.table_scenes.pool import open_pool as open_objects

SCENES, QUICK_SCENES = 16, 6
VIEWS, QUICK_VIEWS = 12, 4
SIZE = (320, 240)


def school(args: argparse.Namespace) -> Found:
    """Return what a second node brings the School."""
    found = Found()
    with tempfile.TemporaryDirectory(prefix="campaign_ray_") as keep:
        job = ScalingJob(kind="nodes", seed=args.seed, keep=Path(keep), quick=args.quick)
        one, two = in_fresh_process(runs, job)
    shares = ", ".join(f"{s:.1f}" for s in two.busy_s)
    found.add(
        "ray_two_nodes_ratio", one.longest_s / two.longest_s,
        f"school: {one.longest_s:.1f} CPU s with one node; of two: asking {two.asking_s:.1f}, "
        f"nodes {shares}",
    )  # fmt: skip
    return found


def generate(args: argparse.Namespace) -> Found:
    """Return what a second node brings the generation of scenes."""
    found = Found()
    one, two = in_fresh_process(made, args)
    shares = ", ".join(f"{s:.1f}" for s in two["busy"])
    found.add(
        "ray_two_nodes_generate_ratio", one["longest"] / two["longest"],
        f"generate: {one['longest']:.1f} CPU s with one node; of two: asking {two['asking']:.1f}, "
        f"nodes {shares}; {one['scenes']} scenes",
    )  # fmt: skip
    return found


def made(args: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the cost of the scenes on one node and on two."""
    request = GenerateRequest(
        pool=open_objects(("pybullet",)), seed=args.seed,
        scene=TableSceneConfig(objects=(3, 5), pool=ObjectPoolConfig(hull_only=True)),
        views=ViewConfig(count=QUICK_VIEWS if args.quick else VIEWS, size=SIZE),
        rendering=SyntheticConfig(profile="d435", maps=()),
    )  # fmt: skip
    numbers = range(QUICK_SCENES if args.quick else SCENES)
    found: list[dict[str, Any]] = []
    with ray_nodes() as (address, add), tempfile.TemporaryDirectory(prefix="campaign_") as folder:
        for count in (1, 2):
            if count == 2:
                add()
            out = Path(folder) / str(count)
            out.mkdir()
            claim(out, request)
            warm = Path(folder) / f"warm{count}"
            warm.mkdir()
            with open_pool(PoolConfig(address=address)) as pool:
                # Two scenes a node, so that each has loaded everything.
                run_many(scene_tasks(warm, range(2 * count), request, 1), pool, _silent)
                counted = CountedWorkers(pool)
                begun = time.process_time()
                summary = run_many(scene_tasks(out, numbers, request, 1), counted, _silent)
                asking = time.process_time() - begun
            busy = tuple(counted.busy.values())
            found.append({
                "asking": asking, "busy": busy, "longest": asking + max(busy),
                "scenes": summary.done,
            })  # fmt: skip
    return found[0], found[1]


def _silent(outcome: Any) -> None:
    """Raise what went wrong."""
    outcome.found()


def losses(args: argparse.Namespace) -> Found:
    """Return whether a lost node changes nothing, and a lost head is told in a sentence."""
    sys.path.append(str(Path(__file__).resolve().parents[1] / "tests/support"))
    from ray_on_loopback import SCENES, generated, generated_with_a_loss, two_nodes

    found = Found()
    with tempfile.TemporaryDirectory(prefix="campaign_") as folder, two_nodes() as nodes:
        _, whole = generated(Path(folder) / "whole")
        at, said, scenes = generated_with_a_loss(Path(folder) / "node", nodes, "node")
        is_equal = 1 <= at < SCENES and said.returncode == 0 and scenes == whole
        told = f"a node killed after {at} of {SCENES} scenes"
        found.add("lost_node_equal", float(is_equal), told)
        at, said, kept = generated_with_a_loss(Path(folder) / "head", nodes, "head")
        again, scenes = generated(Path(folder) / "head")
    lines = [line for line in said.stderr.splitlines() if line.strip()] or [""]
    is_told = (
        said.returncode == 2
        and lines[-1].startswith("error: the Ray cluster")
        and not any("Traceback" in line or "ray." in line for line in lines)
        and kept.items() <= whole.items() and again.returncode == 0 and scenes == whole
    )  # fmt: skip
    found.add("lost_head_told", float(is_told), lines[-1])
    return found
