"""The devices of `realsim capture`: the arm first, then the camera; both troubles are named."""

from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from realsim.errors import InputError, RealsimError
from realsim.records import Target
from realsim.robots.arm import find_arm
from realsim_capture_plans.capturing.look import check_arm
from realsim_capture_plans.devices.interfaces import Arm, DepthCamera, DeviceError
from realsim_capture_plans.planning.record import CapturePlan

if TYPE_CHECKING:
    from realsim.app.capture.run import CaptureRequest
    from realsim_capture_plans.devices.franka import FrankaArm
    from realsim_capture_plans.devices.ur import UrArm
    from realsim_capture_plans.lab import SimulatedLab

Devices = tuple[Arm, DepthCamera | None, "SimulatedLab | None"]


@contextmanager
def open_devices(
    request: "CaptureRequest", plan: CapturePlan, target: Target | None
) -> Generator[Devices]:
    """Connect the arm that the plan is for, and the camera; yields the lab, too, if simulated.

    The camera is None only in a dry run to which none is connected.

    Raises:
        InputError: nothing or two things to capture with, or the arm is not the plan's.
        DeviceError: the arm or the camera is not there; where both fail, both are named.
    """
    if request.simulated == bool(request.robot_host):
        raise InputError(
            "say what to capture with: --robot-host IP (the plan's arm and a RealSense), or "
            "--simulated (the simulated lab)."
        )
    if request.arm:
        _check_named(request.arm, plan)
    if request.simulated:
        yield _simulated(request, plan, target)
        return
    with ExitStack() as stack:
        arm, camera = _real(request, plan, stack)
        yield arm, camera, None


def _check_named(name: str, plan: CapturePlan) -> None:
    """Refuse an arm that the plan was not made for; a folder's arm is known by its name then."""
    arm = find_arm(name)
    if arm.name != plan.robot or arm.joints != plan.chain.joints:
        raise InputError(
            f"--arm {name} is a {arm.name} with {arm.joints} joints, and the plan was made for a "
            f"{plan.robot} with {plan.chain.joints}. Leave --arm out to go with the plan, or make "
            f"one for this arm: `realsim plan --arm {name}`."
        )


def _simulated(request: "CaptureRequest", plan: CapturePlan, target: Target | None) -> Devices:
    from realsim_capture_plans.lab import LabConfig, SimulatedLab

    lab = SimulatedLab(LabConfig(seed=request.seed, arm=plan.robot, n_objects=request.objects))
    check_arm(plan, lab.arm)
    if target is None:
        lab.place_objects()
    else:
        _check_lab_board(lab, target)
        lab.place_board()
    return lab.arm, lab.camera, lab


def _real(
    request: "CaptureRequest", plan: CapturePlan, stack: ExitStack
) -> tuple[Arm, DepthCamera | None]:
    """Return arm and camera, closed with the stack.

    Raises:
        InputError: the arm is not the plan's; the camera's trouble is named, too.
        DeviceError: one of them is not there, or both.
    """
    from realsim_capture_plans.devices.realsense import RealSenseCamera

    arm: Arm | None = None
    camera: DepthCamera | None = None
    troubles: list[RealsimError] = []
    try:
        real_arm = _arm(request.robot_host, plan)
        stack.callback(real_arm.close)
        check_arm(plan, real_arm)
        arm = real_arm
    except RealsimError as error:
        troubles.append(error)
    try:
        if not (request.dry_run and _no_camera()):
            real_camera = RealSenseCamera(request.camera)
            stack.callback(real_camera.close)
            camera = real_camera
    except RealsimError as error:
        troubles.append(error)
    if arm is None or troubles:
        raise _both(troubles)
    return arm, camera


def _arm(host: str, plan: CapturePlan) -> "FrankaArm | UrArm":
    """Return the plan's arm, connected by the driver for arms of its name.

    Raises:
        InputError: there is no driver for it, or it is another arm.
        ArmStoppedError: it cannot be reached, or is not ready.
    """
    from realsim_capture_plans.devices.franka import MODELS, FrankaArm
    from realsim_capture_plans.devices.ur import UrArm

    name = plan.robot.lower()
    if name.startswith("ur"):
        return UrArm(host, model=plan.robot, chain=plan.chain)
    if name.startswith(MODELS):
        return FrankaArm(host, plan.chain)
    raise InputError(
        f"the plan is for a {plan.robot}; drivers come for the arms of Universal Robots (UR...) "
        "and of Franka (Panda, FR3). For another one write a driver: "
        "docs/how-to/write-a-device-driver.md."
    )


def _no_camera() -> bool:
    """Return whether no RealSense is connected, or none can be because the SDK is missing."""
    from realsim.errors import MissingLibraryError
    from realsim.interop import import_pyrealsense2

    try:
        return not list(import_pyrealsense2().context().query_devices())
    except (MissingLibraryError, RuntimeError):
        return True


def _both(troubles: list[RealsimError]) -> RealsimError:
    """Return one error that says all; what has to be given anew (InputError) counts more."""
    if len(troubles) == 1:
        return troubles[0]
    text = "\n".join(
        f"{what}: {error}" for what, error in zip(("robot", "camera"), troubles, strict=True)
    )
    wrong = any(not isinstance(error, DeviceError) for error in troubles)
    return (InputError if wrong else DeviceError)(f"neither robot nor camera is ready.\n{text}")


def _check_lab_board(lab: "SimulatedLab", target: Target) -> None:
    """Refuse a target that does not lie in the simulated lab."""
    from realsim_calibration.targets.target_file import target_to_json

    if target_to_json(target) != target_to_json(lab.board):
        b = lab.board
        raise InputError(
            f"the simulated lab has one board: aprilgrid:{b.columns}x{b.rows},"
            f"tag={1e3 * b.tag_size_m:g}mm,gap={1e3 * b.gap_m:g}mm. Give that line as --board."
        )
