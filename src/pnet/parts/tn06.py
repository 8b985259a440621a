"""TN06: a hexagonal nut. Axis z, first vertex on +x; symmetry D6."""

import numpy as np
import trimesh

from pnet.geometry.symmetry import dihedral
from pnet.parts.base import ParametricPart, Points
from pnet.parts.keypoints import Keypoint
from pnet.parts.orbits import RingOrbit, pair_orbit, polygon_orbit
from pnet.parts.solids import circle, extrude_points, prism, ring_sectors


class TN06(ParametricPart):
    """Hole radius r, height h, circumradius d of the hexagon."""

    name = "tn06"
    parameter_names = ("r", "h", "d")
    keypoints = (
        Keypoint("face", "centroid", pair_orbit((0, 0, 1)), "h", 0.5),
        Keypoint("hole", "face", RingOrbit(), "r"),
        Keypoint("vertex", "face", polygon_orbit(6), "d"),
    )
    symmetry = dihedral(6)

    def check(self, parameters: Points) -> None:
        """The hole must stay inside the hexagon's inscribed circle."""
        r, _, d = parameters
        if r >= d * np.sqrt(0.75):
            raise ValueError(
                f"tn06: the hole (r = {1000 * r:g} mm) is as wide as the hexagon "
                f"(inscribed radius {1000 * d * np.sqrt(0.75):g} mm); make r smaller or d larger"
            )

    def mesh(self, parameters: Points) -> trimesh.Trimesh:
        """A hexagonal prism less a cylinder."""
        r, h, d = parameters
        body = prism(circle(d, 6), -h / 2, h / 2)
        hole = prism(circle(r, self.sections), -h, h)
        return trimesh.boolean.difference([body, hole], engine="manifold")

    def convex_pieces(self, parameters: Points, fill_holes: bool) -> list[Points]:
        """The prism, or sectors between hole and hexagon."""
        r, h, d = parameters
        if fill_holes:
            return [extrude_points(circle(d, 6), -h / 2, h / 2)]
        angle = np.arange(self.sections) * (2 * np.pi / self.sections)
        # the hexagon's edge lies at inscribed radius / cos(angle from the edge's middle)
        edge = d * np.sqrt(0.75) / np.cos(np.mod(angle, np.pi / 3) - np.pi / 6)
        outer = circle(1.0, self.sections) * edge[:, None]
        return ring_sectors(circle(r, self.sections), outer, -h / 2, h / 2)
