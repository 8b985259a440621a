"""What comes after the votes: poses, and for some methods sizes, are fitted to the cloud itself."""

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

from pnet.parts.base import ParametricPart
from pnet.records import Detections


class Refinement(Protocol):
    """Makes instances that were found better by the points that they were found in."""

    def refined(
        self, part: ParametricPart, found: Detections, points: Tensor, scenes: Sequence[int]
    ) -> Detections:
        """The same instances, of several scenes, in the same order.

        Args:
            part: the template.
            found: (d) instances on the CPU, one scene's after the other's; their points' (B, N) instances by
                these numbers.
            points: (B, N, 3) the scenes' clouds, camera frame, metres.
            scenes: how many instances each scene has, B numbers.
        """
        ...
