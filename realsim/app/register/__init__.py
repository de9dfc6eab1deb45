"""The command `realsim register`."""
