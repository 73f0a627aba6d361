"""Operations on tensors: most are differentiable, and most have a plain-PyTorch twin of the same name.

All of them raise ValueError where shapes disagree or a value is out of range, and TypeError where tensors are of
different or unsupported types, or not on one device that has kernels.
"""

from __future__ import annotations

from typing import Literal

Fresnel = Literal["pane", "schlick", "none"]
"""How reflectance follows the angle: as that of a pane with two surfaces, by Schlick's curve of one, or not at all."""
