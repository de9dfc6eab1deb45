"""`realsim export`: sessions and data sets written in the formats that people use."""
