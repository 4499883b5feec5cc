"""Identification: from windows of flight data to parameters with honest intervals."""
