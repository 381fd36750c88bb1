"""The learners and their building blocks."""
