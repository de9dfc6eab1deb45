"""The command `realsim scan`."""
