"""A reviewed scene as one file that opens without a server."""
