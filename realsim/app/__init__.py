"""The command line, the whole loop, and the reports: the one place that knows every stage."""
