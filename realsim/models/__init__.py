"""Object models: meshes read, judged and repaired; symmetries, convex parts, mass; the library."""
