"""Differentiable operations on tensors; each has a CPU kernel and a plain-PyTorch twin of the same name."""
