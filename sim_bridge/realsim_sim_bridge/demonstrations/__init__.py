"""Attempts of the Robot School as demonstrations: what arm, object and cameras did at each step."""
