"""COLMAP: sparse models and the images they place."""
