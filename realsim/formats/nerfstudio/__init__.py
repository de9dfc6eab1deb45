"""nerfstudio's transforms.json, and that of instant-ngp and NeRF before it."""
