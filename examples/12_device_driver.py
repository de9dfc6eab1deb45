"""Write two drivers: an arm that speaks degrees and millimetres, a camera that is a folder."""
# ruff: noqa: D102 - what the methods do is said by the protocols Arm and DepthCamera

import numpy as np
from device_checks import check_arm, check_camera

from realsim import CaptureSession, InputError, images
from realsim.geometry import se3
from realsim.store import SessionStore
from realsim_capture_plans import UR5, Arm, ArmState, DepthCamera, Frame, PlanConfig, capture
from realsim_capture_plans.lab import LabConfig, SimulatedLab
from realsim_capture_plans.planning.make import hemisphere_plan

lab = SimulatedLab(LabConfig(n_objects=2, width=320, height=180))  # stands for the real devices
lab.place_objects()


class VendorArm(Arm):
    """The maker's units (degrees, millimetres, rotation vectors) end here."""

    name, limits, description = "UR5", UR5.limits, {"model": "UR5", "driver": "example 12"}

    def move(self, joints, speed=1.05, acceleration=1.4):
        goal = np.array(joints, dtype=float)
        if goal.shape != (6,) or not np.isfinite(goal).all() or not self.limits.contains(goal):
            raise InputError(f"the goal {goal.tolist()} is not 6 angles [rad] within the limits.")
        lab.arm.move(goal, speed, acceleration)  # robot.move_joints(np.degrees(goal)), then wait

    def state(self):
        s = lab.arm.state()  # robot.read(), which gives:
        degrees, xyz_mm = np.degrees(s.joints), 1e3 * s.T_base_ee[:3, 3]
        T = se3.from_rt(se3.exp_so3(se3.log_so3(s.T_base_ee[:3, :3])), xyz_mm / 1e3)
        return ArmState(joints=np.radians(degrees), T_base_ee=T, time_s=s.time_s)


class FolderCamera(DepthCamera):
    """Plays the images of a recording in their order."""

    name, intrinsics, depth_unit_m = "folder", lab.camera.intrinsics, lab.camera.depth_unit_m

    def __init__(self, folder):
        self.files, self.played = sorted((folder / "rgb").glob("*.png")), 0

    def grab(self):
        rgb, self.played = self.files[self.played % len(self.files)], self.played + 1
        depth_m = images.read_depth(rgb.parents[1] / "depth" / rgb.name, self.depth_unit_m)
        return Frame(rgb=images.read_rgb(rgb), depth_m=depth_m, time_s=self.played / 30)


mount, rng = lab.nominal_T_ee_cam, np.random.default_rng(0)
plan = hemisphere_plan(4, lab.scene_center, mount, PlanConfig(), rng)
header = CaptureSession(name="a", intrinsics=lab.camera.intrinsics, views=(), depth_unit_m=1e-4)
extra = {"plan_hash": plan.content_hash}
first, again = (SessionStore.create(f, header, extra=extra) for f in ("a", "b"))
print(capture(plan, VendorArm(), lab.camera, first).captured, "views recorded")
print("findings:", check_arm(VendorArm()) + check_camera(FolderCamera(first.folder)))
lab.arm.move(plan.home)
print(capture(plan, VendorArm(), FolderCamera(first.folder), again).captured, "views played")
print("equal images:", all(np.array_equal(first.rgb(v), again.rgb(v)) for v in range(4)))
