"""What may be true of bodies: slots of constraints, coordinates, and their prior."""
