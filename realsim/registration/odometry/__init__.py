"""Camera motion from the depth images alone: a check of the robot's, or a substitute for it."""
