"""The soft arm, and what all tasks of it share."""
