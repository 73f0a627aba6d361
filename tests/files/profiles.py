"""Colour profiles as cameras and programs embed them."""

from __future__ import annotations

import struct

from PIL import ImageCms

DISPLAY_P3 = {
    b"rXYZ": (0.51512, 0.24120, -0.00105),
    b"gXYZ": (0.29198, 0.69225, 0.04189),
    b"bXYZ": (0.15710, 0.06657, 0.78407),
}
"""The primaries of Display P3 under D50."""
IN_P3, IN_SRGB = (250, 60, 40), (255, 20, 3)
"""The same colour as stored in P3 and in sRGB."""


def srgb_profile() -> bytes:
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def p3_profile() -> bytes:
    """Display P3, as embedded by phones: the curve of sRGB with other primaries."""
    profile = bytearray(srgb_profile())
    (count,) = struct.unpack_from(">I", profile, 128)
    for index in range(count):
        tag, offset, _ = struct.unpack_from(">4sII", profile, 132 + 12 * index)
        if tag in DISPLAY_P3:
            struct.pack_into(">3i", profile, offset + 8, *(round(65536 * value) for value in DISPLAY_P3[tag]))
    return bytes(profile)
