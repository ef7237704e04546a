"""Matching: whether two gradient maps show the same place, and the transform between them."""
