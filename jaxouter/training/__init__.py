"""Training: configuration, the jitted pipeline, checkpoints, run folders."""
