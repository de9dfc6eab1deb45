"""Bias of a depth camera from views of the board."""
