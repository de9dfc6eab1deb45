"""Carry out a capture plan: move, wait, read the arm, grab, check, store; go on after a stop.

View k of the plan becomes view k of the session. The arm only goes where the plan's collision
model was asked: along the plan's moves or, where it stands elsewhere, on a line that is checked
first. What a person has to clear (a stop of the arm, a camera that is gone) is asked for where
there is a person; otherwise the capture ends, and the same call goes on.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from realsim.errors import InputError
from realsim_capture_plans.capturing.log import CaptureLog
from realsim_capture_plans.capturing.look import CaptureConfig, Looker, check_arm
from realsim_capture_plans.capturing.run import CaptureJob, CaptureSummary, Run
from realsim_capture_plans.devices.interfaces import Arm, DepthCamera
from realsim_capture_plans.plan_files.plan_json import plan_to_json
from realsim_capture_plans.planning.record import CapturePlan

if TYPE_CHECKING:
    from realsim.store import SessionStore

PLAN_FILE = "plan.json"
SHOWN = 4
"""Images that a refusal names."""


def capture(
    plan: CapturePlan,
    arm: Arm,
    camera: DepthCamera,
    store: "SessionStore",
    *,
    progress: Callable[[int, int], None] | None = None,
    config: CaptureConfig | None = None,
    job: CaptureJob | None = None,
) -> CaptureSummary:
    """Capture every view of the plan that the session does not have yet.

    Args:
        plan: where to go.
        arm: the arm, anywhere from where the way to the plan is free.
        camera: the camera on its flange.
        store: the session; created with `extra={"plan_hash": plan.content_hash}`.
        progress: called with (views stored, views of the plan); used where no job is given.
        config: when a frame counts, and how fast the arm goes.
        job: which views, and whom to tell and ask.

    Raises:
        InputError: the session belongs to another plan, arm or camera.
        DeviceError: a device stopped, or a view gave no good frame, and nobody could be asked.
    """
    config = CaptureConfig() if config is None else config
    job = CaptureJob(progress=progress) if job is None else job
    check_views(plan, [*(job.views or ()), *job.retake])
    state = check_arm(plan, arm)
    _check_session(plan, camera, store)
    log = CaptureLog(store)
    first = next((e for e in log.entries if e.get("event") == "begun"), None)
    tool = state.T_ee_tcp if first is None else np.asarray(first["T_ee_tcp"], dtype=np.float64)
    looker = Looker(
        plan, arm, camera, config, board_check=job.board_check, earlier=log.views(),
        T_ee_tcp=tool,
    )  # fmt: skip
    return Run(plan, arm, camera, config, looker, log, job, store).carry_out()


def dry_run(
    plan: CapturePlan,
    arm: Arm,
    camera: DepthCamera | None,
    *,
    config: CaptureConfig,
    job: CaptureJob | None = None,
) -> CaptureSummary:
    """Drive the plan (slowly: `config.speed_scale`) and judge the frames; store nothing.

    Without a camera the moves alone are driven: the rehearsal of a new plan.

    Raises:
        InputError: the plan was made for another arm.
        DeviceError: a device stopped, or a view gave no good frame, and nobody could be asked.
    """
    job = CaptureJob() if job is None else job
    check_views(plan, job.views or ())
    check_arm(plan, arm)
    looker = Looker(plan, arm, camera, config, board_check=job.board_check)
    return Run(plan, arm, camera, config, looker, CaptureLog(None), job, None).carry_out()


def check_views(plan: CapturePlan, views: Sequence[int]) -> None:
    """Refuse numbers that the plan does not have.

    Raises:
        InputError: one is not a view of the plan.
    """
    if wrong := sorted({k for k in views if not 0 <= k < len(plan)}):
        raise InputError(
            f"views {wrong} are not in the plan, which has the views 0 to {len(plan) - 1}."
        )


def _check_session(plan: CapturePlan, camera: DepthCamera, store: "SessionStore") -> None:
    """Refuse a session of another plan or camera; put the plan into it the first time."""
    expected = store.extra.get("plan_hash")
    if expected != plan.content_hash:
        if expected is None:
            raise InputError(
                f"'{store.folder}' was imported, not captured: it has no plan to go on with. "
                "Choose a new folder."
            )
        if (begun := store.extra.get("arm")) not in (None, plan.robot):
            raise InputError(
                f"the session '{store.folder}' was begun with a {begun}, and this plan is for a "
                f"{plan.robot}. A session cannot hold views of two arms: choose a new folder, or "
                f"continue with the plan in {store.folder / PLAN_FILE}."
            )
        raise InputError(
            f"the session was begun with the plan {str(expected)[:12]}..., this plan is "
            f"{plan.content_hash[:12]}... Choose a new folder, or go on with the plan in "
            f"{store.folder / PLAN_FILE}."
        )
    _check_stored(store)
    camera_now, camera_then = camera.intrinsics, store.session.intrinsics
    if (camera_now.width, camera_now.height) != (camera_then.width, camera_then.height):
        raise InputError(
            f"{camera.name} gives {camera_now.width}x{camera_now.height} images; the session has "
            f"{camera_then.width}x{camera_then.height}. Set the camera to that size."
        )
    if (then := store.extra.get("camera")) not in (None, camera.name):
        raise InputError(
            f"the session was begun with {then}, this camera is {camera.name}. Two cameras have "
            "two lenses and two mounts: connect the first one, or begin a new session."
        )
    if not store.has(PLAN_FILE):
        store.write_json(PLAN_FILE, plan_to_json(plan))


def _check_stored(store: "SessionStore") -> None:
    """Refuse to go on where stored images are not what they were, or the beginning is not known.

    Raises:
        InputError: an image is gone or of another size, or session.json was made anew without
            knowing arm, camera and lab.
    """
    from realsim.store.header import SESSION_FILE, repair_command
    from realsim.store.opening import RECOVERED

    if faults := store.stored_faults():
        named = "; ".join(f"{f.path}: {f.found}" for f in faults[:SHOWN])
        more = f"; and {len(faults) - SHOWN} more" if len(faults) > SHOWN else ""
        raise InputError(
            f"stored views of '{store.folder}' are not what was written ({named}{more}). "
            f"{repair_command(store.folder)} puts them aside; the same capture then takes them "
            "again."
        )
    if store.extra.get(RECOVERED):
        known = ", ".join(f"{k}: {v}" for k, v in store.extra.items() if k != RECOVERED)
        raise InputError(
            f"the {SESSION_FILE} of '{store.folder}' was made anew by a repair, so its arm, "
            f"camera and lab are not known for certain ({known}). Views of another arm or "
            "camera would spoil it: capture into a new folder. If you know that all are the "
            f'same, delete "{RECOVERED}" from "extra" in {SESSION_FILE}, and run '
            f"{repair_command(store.folder)}."
        )
