"""Clutter: bodies at uniformly random orientations in the bin's volume, without physics.

Piles rarely show a flat part standing on its rim; clutter shows every orientation equally often.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from pnet.parts.base import ParametricPart
from pnet.scenes.pile import Bin, Pile, Points

ATTEMPTS = 30  # tries to place one body before it is left out


def scatter_bodies(
    part: ParametricPart,
    parameters: Points,
    box: Bin,
    count: int,
    spacing: float,
    rng: np.random.Generator,
) -> Pile:
    """Scatter bodies in the lower part of the bin.

    Args:
        part, parameters: the part object, (k,) metres. count: how many bodies to place.
        spacing: smallest distance of two centroids as a share of the part's bounding sphere's diameter.
    Returns:
        A `Pile` of at most `count` bodies; one that finds no room is left out.
    """
    radius = float(np.linalg.norm(part.mesh(parameters).vertices, axis=1).max())
    half = np.maximum(np.array([box.width, box.depth]) / 2 - radius, 0)
    # as deep as a pile of as many bodies would be
    depth = min(box.height, 2 * radius * (1 + count * (2 * radius) ** 2 / (box.width * box.depth)))
    placed = np.zeros((0, 3))
    for _ in range(count):
        low, high = np.array([*-half, radius]), np.array([*half, max(depth, 2 * radius)])
        candidates = rng.uniform(low, high, (ATTEMPTS, 3))
        gap = np.linalg.norm(candidates[:, None] - placed[None], axis=-1).min(1, initial=np.inf)
        fits = np.flatnonzero(gap >= 2 * radius * spacing)
        if len(fits):
            placed = np.concatenate([placed, candidates[fits[:1]]])
    return Pile(Rotation.random(len(placed), rng=rng).as_matrix(), placed, drop=count)
