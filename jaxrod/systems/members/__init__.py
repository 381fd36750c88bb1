"""Members of a system: rigid bodies, constants and steppers of members."""
