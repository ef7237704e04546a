"""Simulated missions with ground truth: terrain, sensors, rover paths that revisit."""
