"""Poisoning: one channel of a flight multiplied by a factor that comes at once or slowly; what is published?"""
