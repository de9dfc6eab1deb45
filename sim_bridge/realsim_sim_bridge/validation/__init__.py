"""The validation suite of the physics: what an engine at its settings gets right, in numbers."""
