"""The definition of `glassplat.kernels.pane_layers.pane_layers`, in PyTorch."""

from __future__ import annotations

import torch
from torch import Tensor


def pane_layers(pane: Tensor, strength: Tensor) -> tuple[Tensor, Tensor]:
    """See `glassplat.kernels.pane_layers.pane_layers`."""
    shown = torch.where(strength > 0, pane, -1)
    above, along = shown[1:] == shown[:-1], shown[:, 1:] == shown[:, :-1]
    # Three rows that are each the same throughout, and the same as their neighbours.
    row = torch.nn.functional.pad(along, (0, 1), value=True) & torch.nn.functional.pad(along, (1, 0), value=True)
    pair = row[1:] & row[:-1] & above
    inner = torch.nn.functional.pad(pair, (0, 0, 0, 1), value=True) & torch.nn.functional.pad(
        pair, (0, 0, 1, 0), value=True
    )
    return (pane >= 0).to(strength.dtype), (inner & row & (shown >= 0)).to(strength.dtype)
