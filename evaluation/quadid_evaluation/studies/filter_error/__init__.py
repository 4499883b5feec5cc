"""The estimator of `identify` (filter error) on simulated and recorded flights."""
