"""The command `realsim import`."""
