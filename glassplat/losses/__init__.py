"""Terms of the training objective, each `(frame, view, scene) -> scalar`."""
