"""What the review shows, as arrays and bytes: cloud, meshes, photographs, made once a session."""
