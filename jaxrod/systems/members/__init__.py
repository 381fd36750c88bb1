"""Members of a system: rods and rigid bodies, their constants and steppers."""
