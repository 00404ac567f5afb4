"""The command line: `infer`, `predict` and `simulate`, thin around the library."""
