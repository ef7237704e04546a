"""Evaluation: loop candidates held against the truth."""
