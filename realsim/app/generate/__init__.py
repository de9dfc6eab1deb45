"""The command `realsim generate`."""
