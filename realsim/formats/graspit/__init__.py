"""The GraspIT authors' own scenes and grasps."""
