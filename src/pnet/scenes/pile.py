"""The bin and what lies in it. World frame: z up, origin in the middle of the bin's floor, metres."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Bin:
    """An open box with upright walls.

    Attributes:
        width, depth: inner size along world x and y, metres. height: of the walls, metres.
    """

    width: float
    depth: float
    height: float

    def __post_init__(self) -> None:
        if min(self.width, self.depth, self.height) <= 0:
            raise ValueError(
                f"bin is {self.width} x {self.depth} x {self.height} m, every size must be positive"
            )

    def contains(self, position: Points, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether positions (..., 3) lie over the floor between the walls, grown by `margin` metres."""
        half = np.array([self.width, self.depth]) / 2 + margin
        between = np.abs(position[..., :2]) <= half
        inside: NDArray[np.bool_] = np.logical_and(between.all(-1), position[..., 2] >= -margin)
        return inside

    def slabs(self, wall: float) -> list[tuple[Points, Points]]:
        """Floor and walls as boxes of thickness `wall`, metres: half sizes (3,) and centres (3,)."""
        w, d, h, half = self.width / 2, self.depth / 2, self.height / 2, wall / 2
        sides = [
            ((w + wall, d + wall, half), (0, 0, -half)),
            ((half, d + wall, h), (w + half, 0, h)),
            ((half, d + wall, h), (-w - half, 0, h)),
            ((w + wall, half, h), (0, d + half, h)),
            ((w + wall, half, h), (0, -d - half, h)),
        ]
        return [(np.array(size), np.array(centre, float)) for size, centre in sides]


@dataclass(frozen=True, eq=False)
class Pile:
    """Bodies of one part object at rest (or, as clutter, in the air).

    Attributes:
        R: (d, 3, 3), t: (d, 3) part → world, metres.
        drop: how many bodies were dropped so far. escaped: how many of them left the bin.
        settled: False where the time limit came before rest.
    """

    R: Points
    t: Points
    drop: int
    escaped: int = 0
    settled: bool = True
