"""Which views, in which order, by which moves; how good a plan is."""
