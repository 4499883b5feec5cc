"""Inputs on which the product failed once: each with what is right, and what comes out now."""
