"""`realsim demo`: the whole loop in the simulated lab."""
