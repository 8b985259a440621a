"""Gear: a toothed wheel with a hub, as the data set annotates it: a revolution. Axis z, the wheel below.

A part of the Siléane data set out of bounding primitives (Fig. 6): two cylinders; the teeth are inside the
wheel's. Diameter and height are about those of the data set's object (114 and 61 mm); the hub's are ours.
"""

from pnet.geometry.symmetry import RevolutionSymmetry
from pnet.parts.base import ParametricPart, Points
from pnet.parts.primitives import Circle, Plane
from pnet.parts.selection import Keypoint
from pnet.parts.solids import Solid, cylinder

WHEEL = 0.4  # wheel height / total height


class Gear(ParametricPart):
    """Wheel radius r, hub radius b, total height h."""

    name = "gear"
    parameter_names = ("r", "b", "h")
    symmetry = RevolutionSymmetry()
    keypoints = (
        Keypoint("base", "centroid", Plane("-z", at=0)),
        Keypoint("top", "base", Plane("z"), "h"),
        Keypoint("rim", "base", Circle("z"), "r"),
        Keypoint("hub", "top", Circle("z"), "b"),
    )

    def check(self, parameters: Points) -> None:
        """The hub must be narrower than the wheel."""
        r, b, _ = parameters
        if b >= r:
            raise ValueError(
                f"gear: the hub (b = {1000 * b:g} mm) must be narrower than the wheel (r = {1000 * r:g} mm)"
            )

    def solid(self, parameters: Points) -> Solid:
        """Wheel and hub, the base at z = 0."""
        r, b, h = self.split(parameters)
        return cylinder(r, 0, WHEEL * h) | cylinder(b, WHEEL * h, h)
