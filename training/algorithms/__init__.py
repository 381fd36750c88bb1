"""The learners, and what they are made of."""
