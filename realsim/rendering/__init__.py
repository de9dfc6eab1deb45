"""Labels by exact ray casting, photographs, and depth-sensor models."""
