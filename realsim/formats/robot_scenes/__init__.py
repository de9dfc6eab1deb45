"""Scenes for physics engines: URDF folders, MJCF, and USD for Isaac Sim."""
