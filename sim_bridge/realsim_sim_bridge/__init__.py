"""From the registered scene to physics and back: Robot School and label transfer."""
