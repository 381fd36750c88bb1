"""Training runs: the loop, their folder, checkpoints, resuming."""
