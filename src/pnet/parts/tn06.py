"""TN06: a hexagonal nut. Axis z, first vertex on +x; symmetry D6."""

import numpy as np

from pnet.geometry.symmetry import dihedral
from pnet.parts.base import ParametricPart, Points
from pnet.parts.primitives import Circle, Plane, Polygon
from pnet.parts.selection import Keypoint
from pnet.parts.shapes import polygon
from pnet.parts.solids import Solid, cylinder, hole, prism


class TN06(ParametricPart):
    """Hole radius r, height h, circumradius d of the hexagon."""

    name = "tn06"
    parameter_names = ("r", "h", "d")
    symmetry = dihedral(6)
    keypoints = (
        Keypoint("face", "centroid", Plane("z"), "h", factor=0.5),
        Keypoint("hole", "face", Circle("z"), "r"),
        Keypoint("vertex", "face", Polygon(6), "d"),
    )

    def check(self, parameters: Points) -> None:
        """The hole must stay inside the hexagon's inscribed circle."""
        r, _, d = parameters
        if r >= d * np.sqrt(0.75):
            raise ValueError(
                f"tn06: the hole (r = {1000 * r:g} mm) is as wide as the hexagon "
                f"(inscribed radius {1000 * d * np.sqrt(0.75):g} mm); make r smaller or d larger"
            )

    def solid(self, parameters: Points) -> Solid:
        """A hexagonal prism less a cylinder."""
        r, h, d = self.split(parameters)
        return prism(polygon(6, d), -h / 2, h / 2) - hole(cylinder(r, -h / 2, h / 2))
