"""Detection: the database of submaps and the loops found in it."""
