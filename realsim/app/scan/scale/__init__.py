"""The command `realsim scan scale`."""
