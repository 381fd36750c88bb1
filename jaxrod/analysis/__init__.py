"""Analysis of a scene: stable step, frequencies, health."""
