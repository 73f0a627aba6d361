"""How far an image is from a photograph: L1 and structural similarity (Wang et al. 2004), as 3DGS uses them."""

from glassplat.kernels.photometric.operation import Photometric, photometric

__all__ = ["Photometric", "photometric"]
