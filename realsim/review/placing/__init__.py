"""Where an object belongs: steps, points, clicks, ICP, and what tells whether it is right."""
