"""The command `realsim check`."""
