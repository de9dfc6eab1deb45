"""How likely a grasp holds: limit analysis, draws over what is uncertain, trials of real robots."""
