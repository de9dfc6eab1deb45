"""The command `realsim plan`."""
