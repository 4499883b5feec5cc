"""Searches that an identification offers beside its own fit, behind one call:
`quadid_evaluation.optimisers.minimise`."""
