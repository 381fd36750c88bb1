"""The arm as published: the laws of its simulator."""
