"""T-Less 20: an electrical fitting, cuboid below and cylinder above. z up; symmetry: half turns about z.

A part of the Siléane data set out of bounding primitives (Fig. 6): a cuboid and a cylinder. The overall size
is about the data set's (83 × 75.5 × 47 mm); the share of the cylinder is ours.
"""

import numpy as np

from pnet.geometry.symmetry import cyclic, reflection
from pnet.parts.base import ParametricPart, Points
from pnet.parts.primitives import Circle, Plane
from pnet.parts.selection import Keypoint
from pnet.parts.solids import Solid, box, cylinder


class TLess20(ParametricPart):
    """Length l along x, width w along y and height b of the cuboid, radius r of the cylinder, total height
    h."""

    name = "tless20"
    parameter_names = ("l", "w", "b", "r", "h")
    symmetry = cyclic(2)
    mirror = reflection((1, 0, 0))  # of the bounding primitives
    keypoints = (
        Keypoint("base", "centroid", Plane("-z", at=0)),
        Keypoint("end", "base", Plane("x"), "l", factor=0.5),
        Keypoint("side", "base", Plane("y"), "w", factor=0.5),
        Keypoint("shoulder", "end", Plane("z"), "b"),
        Keypoint("top", "base", Plane("z"), "h"),
        Keypoint("rim", "top", Circle("z"), "r"),
    )

    def check(self, parameters: Points) -> None:
        """The cylinder stands on the cuboid and within its width."""
        _, w, b, r, h = parameters
        if r > w / 2 + 1e-9 or b >= h:
            raise ValueError(
                f"tless20: the cylinder must stand within the cuboid (r <= w / 2) and above it (h > b), got "
                f"{self.text(np.asarray(parameters))}"
            )

    def solid(self, parameters: Points) -> Solid:
        """The cylinder on the cuboid, the base at z = 0."""
        length, w, b, r, h = self.split(parameters)
        return box((-length / 2, length / 2), (-w / 2, w / 2), (0, b)) | cylinder(r, b, h)
