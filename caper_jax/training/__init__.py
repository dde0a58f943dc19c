"""Training: optimiser, state, loop, checkpoints, parallelism and export of models."""
