"""What a user of NumPyro asks for: a model of a structure, NUTS, SVI, a kernel."""
