"""Longer studies, each with a `make` target and a recorded result in docs/results."""
