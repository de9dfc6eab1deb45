"""The Franka Panda: kinematics, reach, collision-free and timed paths."""
