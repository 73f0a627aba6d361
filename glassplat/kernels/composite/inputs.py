"""Checks of what the blending operations are given."""

from __future__ import annotations

from glassplat.kernels.records import Splats, TileBins, check_tensors


def check_splats(splats: Splats, bins: TileBins) -> None:
    """Raises where splats and bins do not belong together, or where no kernel exists for them.

    Raises:
        TypeError: the type is neither float32 nor float64, differs between tensors, or they are on different devices.
        ValueError: shapes disagree.
    """
    cameras, count = splats.opacities.shape
    trailing = {"means2d": (2,), "conics": (3,), "opacities": (), "depths": ()}
    check_tensors({name: (getattr(splats, name), (cameras, count, *rest)) for name, rest in trailing.items()})
    if bins.num_cameras != cameras or len(bins.splat_offsets) != cameras * count + 1:
        raise ValueError(
            f"the bins are for {bins.num_cameras} cameras and {len(bins.splat_offsets) - 1} splats, but there are "
            f"{cameras} cameras with {count} splats each; bin these very splats with bin_tiles"
        )


def primary_count(num_primary: int | None, splats: Splats) -> int:
    """The number of primary splats; all of them where none is given."""
    count = splats.opacities.shape[1]
    if num_primary is None:
        return count
    if not 0 <= num_primary <= count:
        raise ValueError(f"num_primary is {num_primary}, expected between 0 and the {count} splats there are")
    return num_primary
