"""Diagnosis: what the simulation gets wrong, why, and what the better model gains."""
