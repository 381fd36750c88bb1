"""Training runs: the training loop, run folders, checkpoints and resuming."""
