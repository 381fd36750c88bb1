"""Tasks of the benchmark's arm and of other soft bodies, one per file."""
