"""A belief that takes one transition at a time, in compiled functions of arrays."""
