"""Training: optimizer, state, loop, checkpoints, parallelism and export of models."""
