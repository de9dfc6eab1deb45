"""The command `realsim capture`."""
