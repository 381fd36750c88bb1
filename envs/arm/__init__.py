"""The soft arm, and the common parts of its tasks."""
