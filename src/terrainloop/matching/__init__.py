"""Matching: whether two gradient maps show the same place, and how they lie."""
