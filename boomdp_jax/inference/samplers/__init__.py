"""Draws over structures and numbers: fitted mixtures, jumps, tempering, evidence."""
