"""Whether a pose can be trusted, told without ground truth."""
