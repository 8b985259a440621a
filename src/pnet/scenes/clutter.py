"""Clutter: bodies at uniformly random orientations in the bin's volume, without physics.

Piles rarely show a flat part standing on its rim; clutter shows every orientation equally often.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from pnet.parts.base import ParametricPart
from pnet.scenes.limits import require_number
from pnet.scenes.overlap import ConvexPiece, penetration
from pnet.scenes.pile import Bin, Pile, Points

ATTEMPTS = 30  # tries to place one body before it is left out


@dataclass(frozen=True)
class Clutter:
    """How bodies are scattered.

    Attributes:
        spacing: smallest distance of two centroids as a share of the part's bounding sphere's diameter.
        density: bodies per volume, against layers of bounding spheres side by side; 2 fills half the depth.
        overlap: whether bodies may reach into each other; False tests their convex pieces exactly (holes
            filled), which takes longer and leaves more bodies out.
    """

    spacing: float = 0.8
    density: float = 1.0
    overlap: bool = True

    def __post_init__(self) -> None:
        require_number("clutter.spacing", self.spacing, 0)
        require_number("clutter.density", self.density, 0, above=True)

    def scatter(
        self, part: ParametricPart, parameters: Points, box: Bin, count: int, rng: np.random.Generator
    ) -> Pile:
        """Scatter bodies in the lower part of the bin.

        Args:
            part, parameters: the part object, (k,) metres. count: how many bodies to place.
        Returns:
            A `Pile` of at most `count` bodies; one that finds no room is left out.
        """
        radius, pieces = _outline(part, tuple(parameters.tolist()))
        half = np.maximum(np.array([box.width, box.depth]) / 2 - radius, 0)
        layers = count * (2 * radius) ** 2 / (box.width * box.depth * self.density)
        depth = min(box.height, 2 * radius * (1 + layers))
        low, high = np.array([*-half, radius]), np.array([*half, max(depth, 2 * radius)])
        turns, placed = np.zeros((0, 3, 3)), np.zeros((0, 3))
        for _ in range(count):
            candidates, turn = rng.uniform(low, high, (ATTEMPTS, 3)), Rotation.random(rng=rng).as_matrix()
            for place in candidates:
                gap = np.linalg.norm(placed - place, axis=1)
                if gap.min(initial=np.inf) < 2 * radius * self.spacing:
                    continue
                near = gap < 2 * radius
                others = list(zip(turns[near], placed[near], strict=True))
                if self.overlap or penetration(pieces, turn, place, others) <= 0:
                    turns, placed = np.concatenate([turns, turn[None]]), np.concatenate([placed, place[None]])
                    break
        return Pile(turns, placed, drop=count)


@lru_cache(maxsize=16)  # a cycle scatters the same part object scene after scene
def _outline(part: ParametricPart, parameters: tuple[float, ...]) -> tuple[float, list[ConvexPiece]]:
    """Radius of a part object's bounding sphere, metres, and its convex pieces without holes."""
    size = np.array(parameters)
    pieces = [ConvexPiece(corners) for corners in part.convex_pieces(size, fill_holes=True)]
    return float(np.linalg.norm(part.mesh(size).vertices, axis=1).max()), pieces
