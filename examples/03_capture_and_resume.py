"""Capture a plan, be interrupted, and go on: nothing is lost and nothing is taken twice."""

import tempfile
from pathlib import Path

import numpy as np

from realsim import CaptureSession
from realsim.store import SessionStore
from realsim_capture_plans import PlanConfig, capture, hemisphere_plan
from realsim_capture_plans.lab import LabConfig, SimulatedLab

VIEWS = 4


def press_ctrl_c_after_two(done: int, total: int) -> None:
    print(f"  {done} of {total} views on disk")
    if done == 2:
        raise KeyboardInterrupt


def run(folder: Path) -> None:
    lab = SimulatedLab(LabConfig(seed=1, n_objects=3, width=320, height=180))
    lab.place_objects()
    rng = np.random.default_rng(0)
    plan = hemisphere_plan(VIEWS, lab.scene_center, lab.nominal_T_ee_cam, PlanConfig(), rng)
    session = CaptureSession(
        name="example",
        intrinsics=lab.camera.intrinsics,
        views=(),
        depth_unit_m=lab.camera.depth_unit_m,
    )
    # The hash ties the session to its plan: another plan is refused when it goes on.
    store = SessionStore.create(folder, session, extra={"plan_hash": plan.content_hash})
    try:
        capture(plan, lab.arm, lab.camera, store, progress=press_ctrl_c_after_two)
    except KeyboardInterrupt:
        print("interrupted")

    store = SessionStore.open(folder)  # as a new process would
    summary = capture(plan, lab.arm, lab.camera, store)
    print(f"gone on: {summary.captured} captured, {summary.skipped} were there")

    print(f"views {sorted(store.completed)}; faults: {store.verify()}")
    image = folder / "depth" / "000002.png"
    image.write_bytes(image.read_bytes()[:-1])
    print(f"after one byte is cut off: {store.verify()}")


with tempfile.TemporaryDirectory() as scratch:
    run(Path(scratch) / "session")
