"""A mission as an estimation problem, for every estimator alike: start, keyframes, measurements."""
