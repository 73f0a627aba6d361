"""Training: the loop, stages, losses, densification and checkpoints."""
