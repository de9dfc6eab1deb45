"""Small valid files of our own, and what reads all of each: for the mutations."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from formats_mutations_scenes import Sample
from reliability_log import Log


def make_results(folder: Path) -> None:
    """Write a session with calibration, board, scene, grasps and what the arm did."""
    from realsim.records import HandEye, Scene, TagBoard
    from realsim.records.grasps import GraspTrajectories
    from realsim.store import results, trajectories
    from registered_sessions import CAMERA, table_session, true_poses
    from reviewed_boxes import grasp_set

    store = table_session(folder, 2, (0.0, 0.0))
    results.save_scene(store, Scene(name="table", objects=tuple(true_poses())))
    results.save_board(store, TagBoard(rows=2, columns=3, tag_size_m=0.03, gap_m=0.01))
    results.save_hand_eye(
        store,
        HandEye(
            T_ee_cam=np.eye(4), covariance=1e-6 * np.eye(6), T_base_board=np.eye(4),
            intrinsics=CAMERA, intrinsics_sd=np.zeros(12), view_indices=(0, 1),
            view_rms_px=np.full(2, 0.1), held_out_px=0.2,
        ),
    )  # fmt: skip
    grasps = grasp_set(1, 0, 6)
    results.save_grasps(store, grasps)
    trajectories.save_trajectories(
        store, grasps,
        GraspTrajectories(
            rows=np.array([1]), starts=np.array([0, 3]), time_s=np.arange(3.0),
            joints_rad=np.zeros((3, 7)), opening_m=np.full(3, 0.04), phase=np.zeros(3, int),
        ),
    )  # fmt: skip
    store.close()


def read_results(folder: Path) -> Any:
    """Open the session and read every result; check it."""
    from realsim.store import SessionStore, results, trajectories
    from realsim.store.opening import read_begun
    from realsim.store.session_check import check_session

    store = SessionStore.open(folder)
    found: list[Any] = [store.session.views, results.load_scene(store), results.load_board(store)]
    found += [results.load_hand_eye(store), read_begun(folder) is None]
    for grasps in results.load_grasps(store):
        found += [grasps, trajectories.load_trajectories(store, grasps)]
    check_session(folder)
    return found


def make_plan(folder: Path) -> None:
    """Write the plan that is shipped."""
    from realsim_capture_plans.plan_files import shipped

    source = Path(next(iter(shipped.__path__))) / "ur5_d405_hemisphere_256.json"
    (folder / "plan.json").write_bytes(source.read_bytes())


def read_plan(folder: Path) -> Any:
    """Read the plan."""
    from realsim_capture_plans.plan_files.plan_json import load_plan

    return [len(load_plan(folder / "plan.json"))]


def make_kept(folder: Path) -> None:
    """Write a depth camera's model, arrays with notes, and a reviewer's journal."""
    import json

    from realsim.records import ObjectPose
    from realsim.rendering.depth_sensors.model import DepthSensorModel
    from realsim.review import journal
    from realsim.store.arrays_on_disk import write_arrays

    (folder / "sensor.json").write_text(json.dumps(DepthSensorModel().document()))
    write_arrays(folder / "kept.npz", {"grid": np.ones((4, 5)), "n": np.arange(3)}, {"key": "a"})
    placed = ObjectPose(obj_id=1, instance=0, T_world_obj=np.eye(4))
    for action in ("accept", "reject"):
        journal.append(folder / "journal.jsonl", journal.new_entry(action, placed, "A. Person"))


def read_kept(folder: Path) -> Any:
    """Read all three."""
    from realsim.rendering.depth_sensors.model import DepthSensorModel
    from realsim.review import journal
    from realsim.store.arrays_on_disk import read_arrays

    entries = journal.replay(journal.read(folder / "journal.jsonl").entries)
    return [
        sorted(read_arrays(folder / "kept.npz")[0]),
        entries,
        DepthSensorModel.load(folder / "sensor.json"),
    ]


OWN = (
    Sample("results of a session", make_results, read_results),
    Sample("plan", make_plan, read_plan),
    Sample("kept files", make_kept, read_kept),
)


# --- the command line -----------------------------------------------------------------------------

TYPED, QUICK_TYPED, BATCH = 5_000, 200, 100
WRONG = (
    "", "-1", "nan", "inf", "1e999", "0x10", "\udcff", "a" * 5000, "../../no", "no/such", "-", "--",
    "--no", "1-", ",", "[", "{}", "x=y", "1,2", "\u202e", "10**9", "99999999999999999999",
)  # fmt: skip
"""What no option wants, or few do."""


def typed(given: argparse.Namespace, log: Log) -> None:
    """Type commands whose first argument is not there, with foreign values: all are refused.

    Where help was asked for, it is given before anything is looked at.
    """
    from click.testing import CliRunner

    from realsim.app.cli import commands
    from realsim.app.command import walk
    from realsim.errors import RealsimError

    every = [(p, c) for p, c in walk(commands).items() if needs_a_source(c)]
    for k in log.todo("typed", given.seed, (QUICK_TYPED if given.quick else TYPED) // BATCH):
        rng, wrong = np.random.default_rng((given.seed, k)), list[str]()
        with CliRunner().isolated_filesystem():
            for _ in range(BATCH):
                path, command = every[int(rng.integers(len(every)))]
                words = [*path, "no/such/source"]
                words += ["--workers", "1"] * any(p.name == "workers" for p in command.params)
                for option in rng.choice(np.array(command.params, object), int(rng.integers(5))):
                    words += [*option.opts[:1], WRONG[int(rng.integers(len(WRONG)))]]
                done = CliRunner().invoke(commands, words)
                helped = "--help-all" in words and done.exit_code == 0
                if not (helped or isinstance(done.exception, RealsimError | OSError | SystemExit)):
                    wrong.append(f"realsim {words}: {done.exception!r}"[:300])
        log.add("typed", given.seed, k, inputs=BATCH, traceback=len(wrong), said=wrong)


def needs_a_source(command: Any) -> bool:
    """Return whether a command's first argument has to be there, so that it cannot begin."""
    import click

    first = next((p for p in command.params if isinstance(p, click.Argument)), None)
    return first is not None and first.required and type(first.type) is click.Path
