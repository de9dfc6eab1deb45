"""Grasp candidates: the hand, antipodal sampling, collision, force closure."""
