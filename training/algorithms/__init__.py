"""The five learners, and what they are made of."""
