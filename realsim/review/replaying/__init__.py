"""A grasp replayed: what its hand did, in words and in the scene."""
