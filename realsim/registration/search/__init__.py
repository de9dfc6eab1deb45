"""Where the objects are, from a rough start, a hint, or nothing at all."""
