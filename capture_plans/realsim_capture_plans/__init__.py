"""Where the robot goes and what executes it: plans, devices, the simulated lab."""

from realsim_capture_plans.capture import CaptureConfig as CaptureConfig
from realsim_capture_plans.capture import CaptureSummary as CaptureSummary
from realsim_capture_plans.capture import capture as capture
from realsim_capture_plans.devices import Arm as Arm
from realsim_capture_plans.devices import ArmState as ArmState
from realsim_capture_plans.devices import DepthCamera as DepthCamera
from realsim_capture_plans.devices import DeviceError as DeviceError
from realsim_capture_plans.devices import Frame as Frame
from realsim_capture_plans.kinematics import UR5 as UR5
from realsim_capture_plans.kinematics import UR5E as UR5E
from realsim_capture_plans.kinematics import DhChain as DhChain
from realsim_capture_plans.kinematics import JointLimits as JointLimits
from realsim_capture_plans.plan import calibration_plan as calibration_plan
from realsim_capture_plans.plan import hemisphere_plan as hemisphere_plan
from realsim_capture_plans.plan_file import load_plan as load_plan
from realsim_capture_plans.plan_file import plan_picture as plan_picture
from realsim_capture_plans.plan_file import save_plan as save_plan
from realsim_capture_plans.plan_record import CapturePlan as CapturePlan
from realsim_capture_plans.plan_record import PlanConfig as PlanConfig
from realsim_capture_plans.plan_record import default_mount as default_mount
