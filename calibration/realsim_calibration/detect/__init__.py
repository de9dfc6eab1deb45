"""Find the points of printed targets in images."""
