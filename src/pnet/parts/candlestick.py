"""Candlestick: a round foot, a thin stem and a cup. Axis z, the foot below; a revolution.

A part of the Siléane data set out of bounding primitives (Fig. 6): three cylinders. Its sizes are not
published; the values are ours.
"""

from pnet.geometry.symmetry import RevolutionSymmetry
from pnet.parts.base import ParametricPart, Points
from pnet.parts.primitives import Circle, Plane
from pnet.parts.selection import Keypoint
from pnet.parts.solids import Solid, cylinder

FOOT = 0.12  # foot height / total height
CUP = 0.3  # cup height / total height
STEM = 0.35  # stem radius / cup radius


class Candlestick(ParametricPart):
    """Foot radius r, cup radius c, total height h."""

    name = "candlestick"
    parameter_names = ("r", "c", "h")
    symmetry = RevolutionSymmetry()
    keypoints = (
        Keypoint("foot", "centroid", Plane("-z", at=0)),
        Keypoint("top", "foot", Plane("z"), "h"),
        Keypoint("rim", "foot", Circle("z"), "r"),
        Keypoint("cup", "top", Circle("z"), "c"),
    )

    def solid(self, parameters: Points) -> Solid:
        """Foot, stem and cup on each other, the foot at z = 0."""
        r, c, h = self.split(parameters)
        foot, stem = cylinder(r, 0, FOOT * h), cylinder(STEM * c, FOOT * h, (1 - CUP) * h)
        return foot | stem | cylinder(c, (1 - CUP) * h, h)
