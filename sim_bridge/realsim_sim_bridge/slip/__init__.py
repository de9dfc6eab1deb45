"""The slip test: loads, worlds of two physics engines, stages."""
