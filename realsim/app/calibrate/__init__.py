"""The command `realsim calibrate`."""
