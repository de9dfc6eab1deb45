"""The metric scale of a mesh from the depth images of a capture session."""
