"""Contact of a rod with fixed bodies."""
