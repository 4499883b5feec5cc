"""Filter-error estimation: parameters, random forces and sensor noise from one likelihood of innovations."""
