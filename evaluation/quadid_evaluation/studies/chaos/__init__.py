"""Chaos: random faults at the running service: did it crash or publish anything wrong, and how soon was it back?"""
