"""The command `realsim render`."""
