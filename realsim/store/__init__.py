"""A session on disk: atomic, checksummed, resumable."""
