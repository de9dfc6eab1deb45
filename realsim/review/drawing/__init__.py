"""Content as nodes of a viser scene."""
