"""Version of quadid."""

__version__ = "0.1.0"
