"""Carrying out a plan: moves, checks of every frame, the operator's view, going on after a stop."""
