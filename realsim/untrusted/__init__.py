"""Files that somebody else made: read with limits, or refused with a reason."""
