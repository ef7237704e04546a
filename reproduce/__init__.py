"""The paper's experiments, re-run: ``python -m reproduce`` from the root of the repository."""
