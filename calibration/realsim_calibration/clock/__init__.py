"""Arm and camera by two clocks: the offset between them, from motion alone."""
