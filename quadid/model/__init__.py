"""The simulation being fitted: the paper's Eqs. 1-10 and, neutral unless freed, every effect of the catalogue."""
