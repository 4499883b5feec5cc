"""How fast everything is, beside its peers and the processor's peak: `python -m quadid_evaluation.benchmarks.speed`."""
