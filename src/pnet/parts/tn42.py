"""TN42: a tapered bar, a prism over a right trapezoid. x along the bar, z up, y across; one mirror plane.

The publication shows only a picture; the sizes are ours.
"""

from pnet.geometry.symmetry import cyclic, reflection
from pnet.parts.base import ParametricPart, Points
from pnet.parts.primitives import Corner, Plane
from pnet.parts.selection import Keypoint
from pnet.parts.shapes import Shape
from pnet.parts.solids import moved, outline, prism

SMALL_END = 0.006  # height of the small end, metres


class TN42(ParametricPart):
    """Length l, height a of the large end, thickness w; the small end's height is fixed."""

    name = "tn42"
    parameter_names = ("l", "a", "w")
    symmetry = cyclic(1)
    mirror = reflection((0, 1, 0))
    keypoints = (
        Keypoint("foot", "centroid", Corner((0, 0, 0))),  # middle of the large end's lower edge
        Keypoint("toe", "foot", Plane("x"), "l"),
        Keypoint("head", "foot", Plane("z"), "a"),
        Keypoint("tip", "toe", Plane("z", at=1000 * SMALL_END)),  # the small end's upper edge
        Keypoint("side", "centroid", Plane("y"), "w", factor=0.5),
    )

    # turned end for end, side for side, or both, it looks much as before: only the taper tells
    lookalikes = (
        (("foot", "toe"), ("head", "tip")),
        (("foot", "head"), ("toe", "tip")),
        (("foot", "tip"), ("toe", "head")),
    )

    def check(self, parameters: Points) -> None:
        """The large end must be the larger one."""
        if parameters[1] <= SMALL_END:
            raise ValueError(
                f"tn42: the large end (a = {1000 * parameters[1]:g} mm) must be higher than the small one "
                f"({1000 * SMALL_END:g} mm)"
            )

    def solid(self, parameters: Points) -> Shape:
        """The trapezoid in the zx plane, extruded along y."""
        length, a, w = self.split(parameters)
        side = outline([(0, 0), (a, 0), (SMALL_END, length), (0, length)])  # z, x
        return moved(prism(side, -w / 2, w / 2), axis="y")
