"""Many inferences in units, done anywhere and in any order, and resumed when killed."""
