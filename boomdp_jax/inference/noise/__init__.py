"""Noise of readings and of the motion, inferred along with everything else."""
