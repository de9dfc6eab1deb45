"""Camera intrinsics: own calibration with covariance, model choice, coverage; camera files."""
