"""What was read: in order of time, in part or wrong, and of which bodies together."""
