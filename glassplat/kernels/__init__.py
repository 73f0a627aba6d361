"""Tensor operations: most are differentiable, and most have a plain-PyTorch twin of the same name.

All of them raise ValueError if shapes disagree or a value is out of range, and TypeError if tensors have different or
unsupported types, or are not on one device with kernels.
"""

from __future__ import annotations

from typing import Literal

Fresnel = Literal["pane", "schlick", "none"]
"""Angular dependence of reflectance: that of a pane with two surfaces, Schlick's curve of one surface, or none."""
