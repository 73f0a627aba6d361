"""Where panes are, and where nothing but one of them is."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.pane_layers import reference as reference
from glassplat.kernels.pane_layers.cpu import pane_layers_kernel
from glassplat.kernels.records import REAL_OF, check_device, check_tensors


@torch.no_grad()
def pane_layers(pane: Tensor, strength: Tensor) -> tuple[Tensor, Tensor]:
    """Two images: 1 in the panes' rectangles, and 1 where a pixel and its eight neighbours show the same pane.

    The second is 0 where nothing reflects: on the rim of a pane, and where it is hit and no glass is there. Pixels
    beyond the border of the image count as those next to them. Not differentiable.

    Args:
        pane: [H, W] int32, which pane is nearest, -1 for none.
        strength: [H, W] of the reflection.

    Returns:
        Both [H, W], of the type of the strength.

    Raises:
        ValueError: shapes disagree.
        TypeError: a pane that is not int32, a strength of an unsupported type, or differing devices.
    """
    check_tensors({"strength": (strength, tuple(pane.shape))})
    check_device("pane", pane, "strength", strength)
    if pane.dtype != torch.int32:
        raise TypeError(f"pane is {pane.dtype}; expected int32")
    if pane.device.type != "cpu":
        # On a GPU these few operations on an image are no bottleneck, so that there they stay PyTorch's.
        return reference.pane_layers(pane, strength)
    hit, inner = torch.empty_like(strength), torch.empty_like(strength)
    tensors = (pane.contiguous(), strength.detach().contiguous(), hit, inner)
    pane_layers_kernel(REAL_OF[strength.dtype])(*(tensor.numpy() for tensor in tensors))
    return hit, inner
