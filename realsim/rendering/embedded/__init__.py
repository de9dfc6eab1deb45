"""The renderer that is always there: surfaces, light and edges of its photographs."""
