"""Questions to ask of a scene: stable step, frequencies, health."""
