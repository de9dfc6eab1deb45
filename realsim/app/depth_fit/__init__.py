"""The command `realsim depth-fit`."""
