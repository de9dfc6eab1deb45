"""Which view next, and when to stop."""
