"""The command `realsim school`."""
