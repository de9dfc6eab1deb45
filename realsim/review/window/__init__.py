"""One browser: its scene, its panels, its keys."""
