"""Evaluation: the paper's comparison, other optimisers, studies and benchmarks; outside the product."""
