"""`realsim config`: settings from a file, and where each came from."""
