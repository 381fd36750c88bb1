"""Parts of tasks with animals: grounds, gaits, what they share."""
