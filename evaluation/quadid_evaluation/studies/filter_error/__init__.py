"""The filter-error estimator on simulated and recorded flights, beside today's fit."""
