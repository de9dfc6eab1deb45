"""The command `realsim annotate`."""
