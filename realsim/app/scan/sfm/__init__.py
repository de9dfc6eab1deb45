"""The command `realsim scan sfm`."""
