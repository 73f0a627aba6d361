"""Operations on tensors: most are differentiable, and most have a plain-PyTorch twin of the same name."""

from __future__ import annotations

from typing import Literal

Fresnel = Literal["pane", "schlick", "none"]
"""How reflectance follows the angle: as that of a pane with two surfaces, by Schlick's curve of one, or not at all."""
