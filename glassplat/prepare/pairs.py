"""Which photographs are compared: all of them with each other, or, of many, neighbours and those that look alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Pairs = list[tuple[int, int]]

MOST_EXHAUSTIVE = 80
"""Photographs of which all pairs are compared; they are 3160."""
NEIGHBOURS = 10
ALIKE = 10
"""Of each photograph: those that it is compared with wherever they were taken, which closes loops."""
WORDS, SAMPLED = 64, 20_000
"""Of the visual vocabulary, and descriptors that it is learned from."""
SEED = 0


def all_pairs(count: int) -> Pairs:
    """Every pair of photographs."""
    return [(one, other) for one in range(count) for other in range(one)]


def neighbouring_pairs(count: int) -> Pairs:
    """The next `NEIGHBOURS` of each photograph in the order they were taken in, and those 16, 32, ... farther."""
    steps = [*range(1, NEIGHBOURS + 1), *(2**power for power in range(4, 10))]
    return [(index + step, index) for index in range(count) for step in steps if index + step < count]


def alike_pairs(descriptors: Sequence[NDArray[np.uint8]]) -> Pairs:
    """The `ALIKE` photographs that look most like each one, by the words of a vocabulary learned from all of them.

    A photograph is described by how its features differ from their nearest words, summed for each word (VLAD, Jégou et
    al. 2010), with signed square roots. No vocabulary learned elsewhere is needed.

    Args:
        descriptors: [F, 128] of each photograph.
    """
    signatures = _signatures([np.asarray(part, dtype=np.float32) for part in descriptors])
    likeness = signatures @ signatures.T
    np.fill_diagonal(likeness, -np.inf)
    nearest = np.argsort(-likeness, axis=1, kind="stable")[:, : min(ALIKE, len(descriptors) - 1)]
    found = {(max(one, int(other)), min(one, int(other))) for one, row in enumerate(nearest) for other in row}
    return sorted(found)


def chosen_pairs(descriptors: Sequence[NDArray[np.uint8]]) -> Pairs:
    """The pairs to compare of photographs with these descriptors."""
    count = len(descriptors)
    if count <= MOST_EXHAUSTIVE:
        return all_pairs(count)
    return sorted({*neighbouring_pairs(count), *alike_pairs(descriptors)})


def _signatures(descriptors: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """[P, WORDS * 128] unit vectors; zeros where a photograph has no features."""
    from scipy.cluster.vq import kmeans2  # Slow to import, and only many photographs need it.

    everything = np.concatenate(descriptors)
    rng = np.random.default_rng(SEED)
    sample = everything[rng.permutation(len(everything))[:SAMPLED]]
    words, _ = kmeans2(sample, min(WORDS, len(sample)), minit="points", rng=rng)
    return np.stack([_signature(part, words) for part in descriptors])


def _signature(features: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    from scipy.cluster.vq import vq

    sums = np.zeros_like(words)
    if len(features):
        nearest, _ = vq(features, words)
        np.add.at(sums, nearest, features - words[nearest])
    sums = np.sign(sums) * np.sqrt(np.abs(sums))
    return (sums / max(float(np.linalg.norm(sums)), 1e-9)).ravel()
