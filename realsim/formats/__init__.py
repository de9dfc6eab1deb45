"""Foreign formats, one file each: units and conventions are converted here and nowhere else."""
