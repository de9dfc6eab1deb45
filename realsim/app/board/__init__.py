"""`realsim board`: calibration targets to print."""
