"""Factor-graph smoothing of inertial and DVL navigation with a weight for every beam."""
