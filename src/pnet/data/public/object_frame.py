"""Where a data set's own object frame lies in pnet's part frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnet.data.public.labelled_image import check_rotations

Points = NDArray[np.float64]


@dataclass(frozen=True)
class ObjectFrame:
    """Carries poses between a data set's object frame and pnet's part frame, in which the origin is the
    volume centroid and a revolution's axis is z.

    Attributes:
        R: 3 x 3 rotation, t: millimetres; object → part: x_part = R x_object + t. For a mesh with the part's
            axes, t is minus its volume centroid.
    """

    R: Sequence[Sequence[float]] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    t: Sequence[float] = (0, 0, 0)

    def __post_init__(self) -> None:
        try:
            R, t = np.asarray(self.R, float), np.asarray(self.t, float)
        except (ValueError, TypeError) as fault:
            raise ValueError(f"data.source.frame: R and t must hold numbers, 3 x 3 and 3 ({fault})") from None
        if R.shape != (3, 3) or t.shape != (3,):
            raise ValueError(
                f"data.source.frame: R has shape {R.shape} and t {t.shape}, expected 3 x 3 and 3"
            )
        check_rotations(R[None], "data.source.frame.R")
        if not np.isfinite(t).all():
            raise ValueError(f"data.source.frame.t is {list(self.t)}, expected three lengths in mm")

    def part_poses(self, R: Points, t: Points) -> tuple[Points, Points]:
        """Poses of the part, given poses (d, 3, 3), (d, 3) of the object, metres."""
        own, origin = np.asarray(self.R, float), np.asarray(self.t, float) / 1000
        R_part = R @ own.T
        return R_part, t - R_part @ origin

    def object_poses(self, R: Points, t: Points) -> tuple[Points, Points]:
        """Poses of the object, given poses (d, 3, 3), (d, 3) of the part, metres: undoes `part_poses`."""
        own, origin = np.asarray(self.R, float), np.asarray(self.t, float) / 1000
        return R @ own, t + R @ origin
