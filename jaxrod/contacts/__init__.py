"""Contact of a rod with bodies that stand still."""
