"""The command `realsim report`."""
