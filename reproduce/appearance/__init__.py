"""Rendered images and point colours of simulated missions, for the baselines that need them."""
