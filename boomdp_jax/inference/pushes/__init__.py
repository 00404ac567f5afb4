"""What pushes tell: of a history at hand, and of wrenches still to be chosen."""
