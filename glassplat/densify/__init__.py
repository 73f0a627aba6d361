"""Edits of the set of Gaussians during training: more where detail is missing, fewer where nothing shows."""
