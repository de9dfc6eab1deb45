"""Depth images fused into the mesh of the object that stands on the table."""
