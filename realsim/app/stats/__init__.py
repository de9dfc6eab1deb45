"""`realsim stats`: what any set of sessions holds, in the figures that papers give."""
