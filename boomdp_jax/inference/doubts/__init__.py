"""Reasons not to trust a posterior, looked for in the readings and in what is left."""
