"""Effects on a rod: loads, damping, supports, actuation."""
