"""Scenes for the school: read from other programs' files, put on a table, tried for standing."""
