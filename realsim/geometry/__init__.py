"""Where things are: rigid transforms, cameras, depth, clouds, meshes, distance fields."""
