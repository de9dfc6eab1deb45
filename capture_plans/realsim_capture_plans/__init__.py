"""Where the robot goes and what executes it: plans, devices, the simulated lab."""

from realsim.robots.arm import UR5 as UR5
from realsim.robots.arm import UR5E as UR5E
from realsim.robots.kinematics import DhChain as DhChain
from realsim.robots.limits import JointLimits as JointLimits
from realsim_capture_plans.capturing.capture import CaptureConfig as CaptureConfig
from realsim_capture_plans.capturing.capture import CaptureSummary as CaptureSummary
from realsim_capture_plans.capturing.capture import capture as capture
from realsim_capture_plans.capturing.capture import dry_run as dry_run
from realsim_capture_plans.capturing.run import CaptureJob as CaptureJob
from realsim_capture_plans.collision.mount import d405_mount as d405_mount
from realsim_capture_plans.devices.interfaces import Arm as Arm
from realsim_capture_plans.devices.interfaces import ArmState as ArmState
from realsim_capture_plans.devices.interfaces import DepthCamera as DepthCamera
from realsim_capture_plans.devices.interfaces import DeviceError as DeviceError
from realsim_capture_plans.devices.interfaces import Frame as Frame
from realsim_capture_plans.plan_files.plan_json import load_plan as load_plan
from realsim_capture_plans.plan_files.plan_json import save_plan as save_plan
from realsim_capture_plans.planning.make import calibration_plan as calibration_plan
from realsim_capture_plans.planning.make import hemisphere_plan as hemisphere_plan
from realsim_capture_plans.planning.record import CapturePlan as CapturePlan
from realsim_capture_plans.planning.record import PlanConfig as PlanConfig
