"""Hand-eye calibration: where the camera sits in the hand, and how sure that is.

The arm of the simulated lab has joint and link errors that its controller does not know of; the
camera has a lens that its maker does not know of. The calibration gets what a real lab would see.
"""

import numpy as np

from realsim.geometry import camera, se3
from realsim.robots.arm import UR5 as UR5_ARM
from realsim_calibration import BoardView, TargetDetection, calibrate_hand_eye
from realsim_capture_plans import PlanConfig, calibration_plan
from realsim_capture_plans.lab import LabConfig, SimulatedLab

PIXEL_NOISE = 0.1

lab = SimulatedLab(LabConfig(seed=3, n_objects=1))
rng = np.random.default_rng(0)
plan = calibration_plan(16, lab.scene_center, lab.nominal_T_ee_cam, PlanConfig(), rng)

board, lens = lab.board, lab.truth.intrinsics
corners_world = se3.transform(lab.truth.T_world_board, board.points_board)
views: list[BoardView] = []
for k, joints in enumerate(plan.joints):
    lab.arm.move(joints)
    # What a detector would find in the photograph: the true corners and some noise.
    T_cam_world = se3.invert(lab.truth.T_world_cam(joints))
    uv = camera.project(lens, se3.transform(T_cam_world, corners_world))
    uv = uv + rng.normal(scale=PIXEL_NOISE, size=uv.shape)
    inside = np.flatnonzero(np.all((uv > 0) & (uv < [lens.width - 1, lens.height - 1]), axis=1))
    seen = TargetDetection(point_ids=inside, uv=uv[inside], image_size=(lens.width, lens.height))
    state = lab.arm.state()
    views.append(BoardView(index=k, T_base_ee=state.T_base_ee, joints=state.joints, detection=seen))

# The arm's kinematics and the joints let the calibration model the arm's own errors.
result = calibrate_hand_eye(views, board, lab.camera.intrinsics, arm=UR5_ARM)

off = se3.invert(lab.truth.T_ee_cam) @ result.T_ee_cam
drawing = se3.invert(lab.truth.T_ee_cam) @ lab.nominal_T_ee_cam
print(f"views used {len(result.view_indices)}, rejected {len(result.rejected)}")
for name, T in (("mount as drawn", drawing), ("calibrated", off)):
    mm, deg = 1e3 * np.linalg.norm(T[:3, 3]), np.degrees(se3.angle(T))
    print(f"{name:15s} off by {mm:6.3f} mm, {deg:7.4f} deg")
print(f"claimed 1 sigma, worst axis {result.sigma_mm:.3f} mm, {result.sigma_deg:.4f} deg")
print(f"focal length {result.intrinsics.fx:.2f} px; true {lens.fx:.2f}")
print(f"views predicted by a fit without them: {result.held_out_px:.2f} px")
