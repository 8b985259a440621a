"""TN34: a stepped round flange with an axial hole. Axis z, the wide disc below; a revolution, ends differ.

The publication shows only a picture; the proportions and sizes are ours.
"""

from pnet.geometry.symmetry import RevolutionSymmetry
from pnet.parts.base import ParametricPart, Points
from pnet.parts.primitives import Circle, Plane
from pnet.parts.selection import Keypoint
from pnet.parts.solids import Solid, cylinder, hole

DISC = 0.3  # disc height / total height
BOSS = 0.6  # boss radius / disc radius
HOLE = 0.3  # hole radius / disc radius


class TN34(ParametricPart):
    """Outer radius r, total height h; the steps and the hole are in fixed proportion."""

    name = "tn34"
    parameter_names = ("r", "h")
    symmetry = RevolutionSymmetry()
    keypoints = (
        Keypoint("base", "centroid", Plane("-z", at=0)),
        Keypoint("top", "base", Plane("z"), "h"),
        Keypoint("rim", "base", Circle("z"), "r"),
    )

    def solid(self, parameters: Points) -> Solid:
        """Disc and boss less the hole, the base at z = 0."""
        r, h = self.split(parameters)
        body = cylinder(r, 0, DISC * h) | cylinder(BOSS * r, DISC * h, h)
        return body - hole(cylinder(HOLE * r, 0, h))
