"""What pixel rays meet: triangle by triangle, exact, in the raw image."""
