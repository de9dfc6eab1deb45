"""The command `realsim upgrade`."""
