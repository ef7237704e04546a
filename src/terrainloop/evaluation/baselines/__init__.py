"""Other methods, and ours, behind one interface: a file each, compared on the same submaps and pairs."""
