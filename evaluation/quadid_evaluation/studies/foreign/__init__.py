"""Vehicles and logs that nobody here flew or simulated: truth, what is answered, and how far plain learning gets."""
