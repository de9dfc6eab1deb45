"""The command `realsim review`, and what it brings to the review from the other packages."""
