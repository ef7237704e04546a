"""Evaluation: scored pairs of submaps against ground truth."""
