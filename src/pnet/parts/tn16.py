"""TN16: a cylinder with a cone on each end. Axis z; a revolution with equal ends.

The publication shows only a picture; the sizes are ours.
"""

from pnet.geometry.symmetry import RevolutionSymmetry
from pnet.parts.base import ParametricPart, Points
from pnet.parts.primitives import Plane
from pnet.parts.selection import Keypoint, cone_keypoints
from pnet.parts.solids import Solid, cone, cylinder


class TN16(ParametricPart):
    """Radius r, cylinder height h, cone height c."""

    name = "tn16"
    parameter_names = ("r", "h", "c")
    symmetry = RevolutionSymmetry(rotoreflection=True)
    keypoints = (
        Keypoint("end", "centroid", Plane("z"), "h", factor=0.5),
        *cone_keypoints("rim", "apex", reference="end", axis="z", radius="r", height="c"),
    )

    def solid(self, parameters: Points) -> Solid:
        """A cylinder between two cones."""
        r, h, c = self.split(parameters)
        return cylinder(r, -h / 2, h / 2) | cone(r, 0, h / 2, h / 2 + c) | cone(0, r, -h / 2 - c, -h / 2)
