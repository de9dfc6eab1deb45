"""The hand-eye estimate: board poses, closed forms, the joint fit, robot errors, uncertainty."""
