"""Plans as files: realsim's own, other people's, and for other people's tools."""
