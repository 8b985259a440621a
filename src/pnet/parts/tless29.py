"""T-Less 29: an electrical fitting, a wide cuboid with a narrower one above. z up; symmetry: half turns about
z.

A part of the Siléane data set out of bounding primitives: two cuboids. Its sizes are not known to us; the
values are ours.
"""

import numpy as np

from pnet.geometry.symmetry import cyclic, reflection
from pnet.parts.base import ParametricPart, Points
from pnet.parts.primitives import Plane
from pnet.parts.selection import Keypoint
from pnet.parts.solids import Solid, box


class TLess29(ParametricPart):
    """Length l along x and width w along y of both cuboids' outline, height b of the lower one, total height
    h, length s of the upper one."""

    name = "tless29"
    parameter_names = ("l", "w", "b", "s", "h")
    symmetry = cyclic(2)
    mirror = reflection((1, 0, 0))  # of the bounding primitives
    keypoints = (
        Keypoint("base", "centroid", Plane("-z", at=0)),
        Keypoint("end", "base", Plane("x"), "l", factor=0.5),
        Keypoint("side", "base", Plane("y"), "w", factor=0.5),
        Keypoint("shoulder", "end", Plane("z"), "b"),
        Keypoint("top", "base", Plane("z"), "h"),
        Keypoint("edge", "top", Plane("x"), "s", factor=0.5),
    )

    def check(self, parameters: Points) -> None:
        """The upper cuboid stands on the lower one."""
        length, _, b, s, h = parameters
        if s > length + 1e-9 or b >= h:
            raise ValueError(
                "tless29: the upper cuboid must be no longer than the lower one (s <= l) and stand above it "
                f"(h > b), got {self.text(np.asarray(parameters))}"
            )

    def solid(self, parameters: Points) -> Solid:
        """The upper cuboid on the lower, the base at z = 0."""
        length, w, b, s, h = self.split(parameters)
        y = (-w / 2, w / 2)
        return box((-length / 2, length / 2), y, (0, b)) | box((-s / 2, s / 2), y, (b, h))
