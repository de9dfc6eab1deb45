"""`realsim doctor`: what of this machine is fit for realsim, and what is missing."""
