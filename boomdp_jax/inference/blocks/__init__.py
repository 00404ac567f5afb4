"""Bodies that must be inferred together, as a sampling problem with names."""
