"""The arm: kinematics both ways, limits, and the controller's own calibration."""
