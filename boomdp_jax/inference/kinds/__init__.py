"""Objects of a few kinds, which tell of each other: a Dirichlet-process mixture."""
