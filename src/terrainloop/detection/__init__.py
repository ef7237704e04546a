"""Detection: stored submaps, the loop closures found among them, and runs over whole missions."""
