"""GraspNet-1Billion: scenes, cameras, grasps."""
