"""The baselines and our own pipeline behind one interface, `method`: one file per method."""
