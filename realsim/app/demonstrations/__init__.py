"""The command `realsim demonstrations`."""
