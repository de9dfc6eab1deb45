"""Calibration from pairs of poses: how sure each measured pose is, found out from the pairs."""
