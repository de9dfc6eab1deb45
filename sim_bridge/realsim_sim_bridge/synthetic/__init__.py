"""Synthetic views of a placed scene, written as a session that every other command opens."""
