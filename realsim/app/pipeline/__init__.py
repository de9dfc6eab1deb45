"""`realsim pipeline`: a whole campaign over many scenes, from one file."""
