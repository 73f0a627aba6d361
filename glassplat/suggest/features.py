"""SIFT features of photographs (Lowe 2004), and what their mirror images would look like."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from glassplat.data.colmap_library import pycolmap
from glassplat.data.view import View

Array = NDArray[np.float64]
Descriptors = NDArray[np.float32]

LONGEST = 1000
"""Pixels of the longer side to which photographs are reduced."""
MOST = 2000
LEAST_CONTRAST = 0.002
"""As COLMAP's peak threshold, a third of its usual one: reflections in glass are faint."""


@dataclass(frozen=True)
class Features:
    """Of one photograph.

    Attributes:
        pixels: [F, 2] in the view's full size.
        sizes: [F] pixels.
        turns: [F] radians, from +x towards +y.
        descriptors: [F, 128] of unit length: 4 rows, 4 columns and 8 directions of gradients.
    """

    pixels: Array
    sizes: Array
    turns: Array
    descriptors: Descriptors

    def __len__(self) -> int:
        return len(self.sizes)


def mirrored(descriptors: Descriptors) -> Descriptors:
    """[F, 128] what the same places would have in a photograph that was turned left to right.

    A feature's patch is turned so that its main direction is +x. The mirrored patch, turned by its own, is the first
    one with top and bottom exchanged: rows change places, and directions their signs.
    """
    bins = descriptors.reshape(-1, 4, 4, 8)[:, ::-1]
    return np.ascontiguousarray(bins[..., -np.arange(8) % 8]).reshape(-1, 128)


def photo_features(view: View) -> Features:
    """The strongest features of a photograph."""
    image = Image.fromarray(view.read_photo().numpy()).convert("L")
    width = image.width
    image.thumbnail((LONGEST, LONGEST), Image.Resampling.LANCZOS)
    return features_of(np.asarray(image), width / image.width)


def features_of(pixels: NDArray[np.uint8], scale: float = 1.0) -> Features:
    """The strongest features of a grey picture [H, W], in pixels of one that is `scale` times as large."""
    options = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    options.sift.max_num_features = MOST
    options.sift.peak_threshold = LEAST_CONTRAST
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    keypoints, found = extractor.extract_from_uint8_array(np.ascontiguousarray(pixels))
    places = np.array([[one.x, one.y, one.compute_scale(), one.compute_orientation()] for one in keypoints])
    places = places.reshape(-1, 4)
    # COLMAP counts a place once that has several directions.
    largest = np.argsort(-places[:, 2], kind="stable")[:MOST]
    places, descriptors = places[largest], np.asarray(found.data, dtype=np.float32).reshape(-1, 128)[largest]
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return Features(
        pixels=scale * places[:, :2],
        sizes=scale * places[:, 2],
        turns=places[:, 3],
        descriptors=descriptors / np.maximum(lengths, 1e-6),
    )
