"""Where the robot goes and what executes it: plans, devices, the simulated lab."""
