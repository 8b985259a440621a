"""TN34: a stepped round flange with an axial hole. Axis z, the wide disc below; a revolution, ends differ.

The publication shows only a picture; the proportions and sizes are ours.
"""

import numpy as np
import trimesh

from pnet.geometry.symmetry import RevolutionSymmetry
from pnet.parts.base import ParametricPart, Points
from pnet.parts.keypoints import Keypoint
from pnet.parts.orbits import RingOrbit, point_orbit
from pnet.parts.solids import circle, extrude_points, lathe, ring_sectors

DISC = 0.3  # disc height / total height
BOSS = 0.6  # boss radius / disc radius
HOLE = 0.3  # hole radius / disc radius
_DISC_SHARE = DISC * (1 - HOLE**2)
_BOSS_SHARE = (1 - DISC) * (BOSS**2 - HOLE**2)
# height of the volume centroid above the base / total height
CENTROID = (_DISC_SHARE * DISC / 2 + _BOSS_SHARE * (1 + DISC) / 2) / (_DISC_SHARE + _BOSS_SHARE)


class TN34(ParametricPart):
    """Outer radius r, total height h; the steps and the hole are in fixed proportion."""

    name = "tn34"
    parameter_names = ("r", "h")
    keypoints = (
        Keypoint("base", "centroid", point_orbit((0, 0, -1)), "h", CENTROID),
        Keypoint("top", "base", point_orbit((0, 0, 1)), "h"),
        Keypoint("rim", "base", RingOrbit(), "r"),
    )
    symmetry = RevolutionSymmetry()

    def check(self, parameters: Points) -> None:
        """Every positive radius and height makes a flange."""

    def mesh(self, parameters: Points) -> trimesh.Trimesh:
        """The stepped profile turned about z."""
        r, h = parameters
        radius = r * np.array([HOLE, 1, 1, BOSS, BOSS, HOLE])
        z = h * (np.array([0, 0, DISC, DISC, 1, 1]) - CENTROID)
        return lathe(np.stack([radius, z], -1), self.sections)

    def convex_pieces(self, parameters: Points, fill_holes: bool) -> list[Points]:
        """Disc and boss, or the sectors of both rings."""
        r, h = parameters
        steps = [(r, 0.0, DISC), (BOSS * r, DISC, 1.0)]
        pieces: list[Points] = []
        for radius, low, high in steps:
            outer, heights = circle(radius, self.sections), ((low - CENTROID) * h, (high - CENTROID) * h)
            if fill_holes:
                pieces.append(extrude_points(outer, *heights))
            else:
                pieces += ring_sectors(circle(HOLE * r, self.sections), outer, *heights)
        return pieces
