"""Training: configuration and presets, pretraining, the jitted pipeline, checkpoints, run folders."""
