"""Training runs: the loop, the folder of a run, checkpoints, resuming."""
