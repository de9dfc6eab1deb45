"""Grasps as files: realsim's own and those of other programs."""
