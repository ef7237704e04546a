"""Gaussian processes over the elevation."""
