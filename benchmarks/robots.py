"""Benchmark of arms and hands as data: what is reached, planned, tried and proven with each.

    uv run python benchmarks/robots.py [--quick] [--json FILE] [--seed N] [--part NAME]

Parts and the figures they give (keys of the JSON's "figures"):
  shelf    hands, arms                  that ship and are right by `realsim robots check`
           new_hand_code_lines, new_arm_code_lines
                                        lines of Python in the folders of the hand and the arm of
                                        the examples, which are in no package; both are checked, the
                                        arm plans a tour and the hand passes the physics' suite
  inverse  ik_found_share_min           poses that a dense search by Pinocchio reaches, and ours
                                        too: the worst arm
  plans    plan_cpu_s_worst             CPU seconds of a hemisphere of 256 views, the worst arm of
                                        those that reach the cap
           tour_over_bound_worst        tour time over the Held-Karp bound
  school   ur5_2f85_grasps_per_s, panda_grasps_per_s
                                        MuJoCo, two processes on two cores, of CPU seconds
           plans_per_s_panda, plans_per_s_worst
                                        collision-free trajectories of one core; the worst of the
                                        other arms
  arc      arc_error_mm                 the Robotiq hands' arcs against their closed loops of links
  demo     panda_demo_handeye_mm, panda_demo_mssd_mm
                                        the whole loop with a Panda
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import blas_threads  # noqa: F401
import numpy as np
from figures import Figure, Found, Goal, run
from school_cases import cut_shapes, keep_option

from realsim.app.console import Console
from realsim.arrays import Array, Mask
from realsim.errors import DegenerateError
from realsim.geometry import se3
from realsim.interop import import_pinocchio
from realsim.robots.arm import RobotArm, find_arm
from realsim.robots.check_arm import check_arm
from realsim.robots.check_hand import check_hand
from realsim.robots.coal_geometry import pinocchio_model
from realsim.robots.robot_files import names_of
from realsim_capture_plans import PlanConfig, d405_mount
from realsim_capture_plans.planning.advise import advise
from realsim_capture_plans.planning.make import hemisphere_plan

EXAMPLES = Path(__file__).parents[1] / "examples" / "robots"
POSES, QUICK_POSES = 150, 24
"""Random poses an arm is asked for: three times as many as it reaches, or so."""
STARTS, QUICK_STARTS = 60, 20
"""Random joints from which Pinocchio's search starts at each pose."""
SEARCH_STEPS, SEARCH_END = 60, 1e-8
VIEWS, QUICK_VIEWS = 256, 8
QUICK_ARMS = ("panda", "xarm6")
"""Seven joints, and six without a closed form: what plans in the short run."""
CAP_SHARE = 0.8
"""An arm reaches the cap where so much of it is reached from the best place."""
AIM_HEIGHT_M = 0.05
DISTANCES_M, QUICK_DISTANCE_M = (0.25, 0.30, 0.35, 0.40, 0.50, 0.60), 0.4


def shelf(given: argparse.Namespace) -> Found:
    """Check every robot that ships, and count the code of those of the examples."""
    found = Found()
    right = {"arm": 0, "hand": 0}
    shelves = {"arm": (names_of("arm"), check_arm), "hand": (names_of("hand"), check_hand)}
    for kind, (names, check) in shelves.items():
        for robot in names:
            wrong = [f for f in check(robot)[1] if not f.is_right]
            right[kind] += not wrong
            found.notes += [f"{robot}: {f.what}: {f.found}" for f in wrong]
    found.add("arms", right["arm"], ", ".join(names_of("arm")))
    found.add("hands", right["hand"], ", ".join(names_of("hand")))
    for kind, folder, check in (
        ("arm", EXAMPLES / "six_joint_arm", check_arm),
        ("hand", EXAMPLES / "two_pad_hand", check_hand),
    ):
        wrong = [f.what for f in check(str(folder))[1] if not f.is_right]
        lines = sum(len(p.read_text().splitlines()) for p in folder.rglob("*.py"))
        if not wrong:
            found.add(f"new_{kind}_code_lines", lines, f"{folder.name}: a TOML and what it names")
    return found


# --- inverse kinematics ---------------------------------------------------------------------------


def inverse(given: argparse.Namespace) -> Found:
    """Ask every arm for random poses, and Pinocchio for the same."""
    found, shares = Found(), dict[str, float]()
    for robot in names_of("arm"):
        arm = find_arm(robot)
        Ts = _poses(arm, QUICK_POSES if given.quick else POSES, given.seed)
        rng = np.random.default_rng(given.seed)
        reached = _searched(arm, Ts, QUICK_STARTS if given.quick else STARTS, rng)
        begin = time.process_time()
        _, of = arm.chain.inverse_branches(Ts)
        ms = 1e3 * (time.process_time() - begin) / len(Ts)
        ours = np.isin(np.arange(len(Ts)), of)
        shares[robot] = float(np.mean(ours[reached])) if reached.any() else np.nan
        found.notes.append(
            f"{robot}: {int((ours & reached).sum())} of {int(reached.sum())} that the search "
            f"reaches, and {int((ours & ~reached).sum())} more; {ms:.2f} ms a pose"
        )
    found.add("ik_found_share_min", min(shares.values()), min(shares, key=lambda n: shares[n]))
    found.cases["ik"] = shares
    return found


def _poses(arm: RobotArm, count: int, seed: int) -> Array:
    """Return half poses of random joints, half random poses in the arm's own box."""
    rng = np.random.default_rng([seed, arm.joints])
    limits = arm.chain.limits
    q = rng.uniform(limits.lower, limits.upper, (count, arm.joints))
    Ts = arm.chain.forward(q)
    low, high = Ts[:, :3, 3].min(axis=0), Ts[:, :3, 3].max(axis=0)
    free = count // 2
    axes = rng.normal(size=(free, 3))
    axes *= rng.uniform(0, np.pi, (free, 1)) / np.linalg.norm(axes, axis=1, keepdims=True)
    Ts[:free] = se3.from_rt(se3.exp_so3(axes), rng.uniform(low, high, (free, 3)))
    return Ts


def _searched(arm: RobotArm, Ts: Array, starts: int, rng: np.random.Generator) -> Mask:
    """Return which poses Pinocchio's damped Newton steps reach inside the limits from any start."""
    pin = import_pinocchio()

    model, frames = pinocchio_model(arm.chain)
    data, end = model.createData(), pin.SE3(frames[-1])
    low, high = arm.chain.limits.lower, arm.chain.limits.upper
    reached = np.zeros(len(Ts), dtype=np.bool_)
    for k, T in enumerate(Ts):
        goal = pin.SE3(T) * end.inverse()
        for _ in range(starts):
            q, size = rng.uniform(np.maximum(low, -np.pi), np.minimum(high, np.pi)), np.inf
            for _ in range(SEARCH_STEPS):
                pin.forwardKinematics(model, data, q)
                error = pin.log6(data.oMi[arm.joints].actInv(goal))
                size = float(np.linalg.norm(error.vector))
                if size < SEARCH_END:
                    break
                J = pin.Jlog6(data.oMi[arm.joints].actInv(goal)) @ pin.computeJointJacobian(
                    model, data, q, arm.joints
                )
                damped = J @ J.T + 1e-3 * min(size, 1.0) ** 2 * np.eye(6) + 1e-12 * np.eye(6)
                step = J.T @ np.linalg.solve(damped, error.vector)
                q = np.clip(q + np.clip(step, -0.5, 0.5), low, high)
            if size < SEARCH_END:
                reached[k] = True
                break
    return reached


# --- capture plans --------------------------------------------------------------------------------


def plans(given: argparse.Namespace) -> Found:
    """Plan a hemisphere with every arm that reaches the cap, each at its best place."""
    found, cpu_s, ratios = Found(), dict[str, float](), dict[str, float]()
    views = QUICK_VIEWS if given.quick else VIEWS
    config, mount = PlanConfig(), d405_mount()
    for robot in QUICK_ARMS if given.quick else names_of("arm"):
        chain, center = find_arm(robot).chain, (QUICK_DISTANCE_M, 0.0, AIM_HEIGHT_M)
        try:
            if not given.quick:
                center = advise(
                    chain, mount, config, views, AIM_HEIGHT_M,
                    distances_m=DISTANCES_M, lifts_m=(0.0,),
                )[0].center  # fmt: skip
            begin = time.process_time()
            rng = np.random.default_rng(given.seed)
            plan = hemisphere_plan(views, center, mount, config, rng, chain=chain)
        except DegenerateError as error:
            found.notes.append(f"{robot}: no plan ({str(error)[:160]})")
            continue
        spent = time.process_time() - begin
        share = plan.metrics["reachable_share"]
        found.notes.append(
            f"{robot}: {spent:.1f} CPU s, tour {plan.metrics['seconds']:.0f} s, "
            f"{plan.metrics['tour_over_bound']:.3f} of the bound, reaches {100 * share:.0f} % of "
            f"the cap from x = {center[0]:.2f} m"
        )
        if share >= CAP_SHARE:
            cpu_s[robot], ratios[robot] = spent, plan.metrics["tour_over_bound"]
    over = f"{views} views; {len(cpu_s)} arms reach {100 * CAP_SHARE:.0f} % of the cap"
    found.add(
        "plan_cpu_s_worst", max(cpu_s.values()), f"{max(cpu_s, key=lambda n: cpu_s[n])}; {over}"
    )
    worst = max(ratios, key=lambda n: ratios[n])
    found.add("tour_over_bound_worst", ratios[worst], worst)
    found.cases["plans"] = {n: [cpu_s[n], ratios[n]] for n in cpu_s}
    return found


# --- the School -----------------------------------------------------------------------------------


def school(given: argparse.Namespace) -> Found:
    """Try grasps with two pairs of arm and hand, and plan with every arm."""
    from school_speed import pair_rate, plan_rate

    cut_shapes(given.keep, given.quick)
    found = Found()
    for key, arm, hand in (
        ("panda_grasps_per_s", "panda", "franka_hand"),
        ("ur5_2f85_grasps_per_s", "ur5", "robotiq_2f85"),
    ):
        rate, told = pair_rate(given.seed, given.keep, given.quick, arm, hand)
        found.add(key, rate, told)
    rates: dict[str, float] = {}
    for arm in QUICK_ARMS if given.quick else names_of("arm"):
        rates[arm], told = plan_rate(given.seed, given.keep, given.quick, arm)
        found.notes.append(f"{arm}: {rates[arm]:.0f} plans/s; {told}")
    found.add("plans_per_s_panda", rates.pop("panda"))
    worst = min(rates, key=lambda n: rates[n])
    found.add("plans_per_s_worst", rates[worst], worst)
    return found


# --- hands, and the whole loop --------------------------------------------------------------------


def arc(given: argparse.Namespace) -> Found:
    """Compare the arcs of the Robotiq hands with their closed loops of links."""
    del given
    sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))
    from robotiq_linkages import LOOPS, arc_error_mm  # pyright: ignore[reportMissingImports]

    errors = {name: arc_error_mm(name) for name in LOOPS}
    return Found(
        figures={"arc_error_mm": max(errors.values())},
        over={"arc_error_mm": ", ".join(f"{n} {e:.3f}" for n, e in errors.items())},
    )


def demo(given: argparse.Namespace) -> Found:
    """Run the whole loop with a Panda."""
    from realsim.app.demo.run import DemoConfig, run_demo

    size = {"views": 5, "objects": 1, "grasps_per_object": 2} if given.quick else {}
    with tempfile.TemporaryDirectory() as folder:
        config = DemoConfig(seed=given.seed, arm="panda", **size)
        figures = run_demo(config, Path(folder) / "demo", Console(quiet=True)).errors.figures()
    return Found(
        figures={
            "panda_demo_handeye_mm": figures["handeye_mm"],
            "panda_demo_mssd_mm": figures["object_mssd_mm"],
        }
    )


FIGURES = {
    "hands": Figure(unit="", goal=Goal(low=4), rival="robosuite 1.5: 13 grippers"),
    "arms": Figure(unit="", goal=Goal(low=7)),
    "new_hand_code_lines": Figure(unit="", goal=Goal(high=0), rival="robosuite: one class"),
    "new_arm_code_lines": Figure(unit="", goal=Goal(high=0)),
    "ik_found_share_min": Figure(unit="", goal=Goal(low=0.995)),
    "plan_cpu_s_worst": Figure(unit="s", goal=Goal(high=40.0)),
    "tour_over_bound_worst": Figure(unit="", goal=Goal(high=1.3)),
    "ur5_2f85_grasps_per_s": Figure(unit="1/s", goal=Goal(low=35.0)),
    "panda_grasps_per_s": Figure(unit="1/s"),
    "plans_per_s_panda": Figure(unit="1/s core", goal=Goal(low=400.0)),
    "plans_per_s_worst": Figure(unit="1/s core", goal=Goal(low=150.0)),
    "arc_error_mm": Figure(unit="mm", goal=Goal(high=0.2)),
    "panda_demo_handeye_mm": Figure(unit="mm", goal=Goal(high=0.5)),
    "panda_demo_mssd_mm": Figure(unit="mm", goal=Goal(high=0.3)),
}
PARTS = {
    "shelf": shelf, "inverse": inverse, "plans": plans, "school": school, "arc": arc, "demo": demo,
}  # fmt: skip


if __name__ == "__main__":
    packages = ("realsim", "numpy", "pin", "coal", "eaik", "mujoco")
    run("robots", __doc__ or "", packages, FIGURES, PARTS, options=keep_option)
