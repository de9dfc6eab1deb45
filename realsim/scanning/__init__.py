"""Scanning objects: metric scale of a mesh from a session, structure from motion, depth fusion."""
