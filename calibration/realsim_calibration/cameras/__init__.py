"""Several cameras calibrated together: in the hand and standing still, one robot, shared boards."""
