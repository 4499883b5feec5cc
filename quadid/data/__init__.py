"""Data: samples, recordings, windows, and channels resampled onto uniform grids."""
