"""The empty bin as a camera sees it. A `Scene` does not hold the bin, so an export draws it where asked."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pnet.geometry.camera import Camera
from pnet.scenes.pile import Bin
from pnet.scenes.viewpoints import Viewpoints

Points = NDArray[np.float64]
SEAM = 1e-9  # metres by which floor and walls reach over their borders, so that no ray slips between two


@dataclass(frozen=True, eq=False)
class Background:
    """The empty bin before a camera that stands still.

    Attributes:
        box: the bin. R: (3, 3), t: (3,) world → camera, metres; world z up, its origin in the middle of the
            floor.
    """

    box: Bin
    R: Points
    t: Points

    def __post_init__(self) -> None:
        R, t = np.asarray(self.R, float), np.asarray(self.t, float)
        if R.shape != (3, 3) or t.shape != (3,) or not (np.isfinite(R).all() and np.isfinite(t).all()):
            raise ValueError(
                f"background: expected finite R (3, 3) and t (3,), got {R.tolist()}, {t.tolist()}"
            )
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
            raise ValueError(f"background: R is no rotation: {R.tolist()}")

    @classmethod
    def seen_from(cls, viewpoints: Viewpoints, box: Bin) -> "Background":
        """The bin as `viewpoints` show it.

        Raises:
            ValueError: where they are more than one place, since a scene does not tell which was drawn.
        """
        (near, far), (upright, oblique) = viewpoints.distance, viewpoints.tilt
        if near != far or upright != oblique or viewpoints.turn:
            raise ValueError(
                f"the camera moves from scene to scene (view.distance {near} to {far} m, view.tilt {upright} "
                f"to {oblique} degrees, view.turn {viewpoints.turn}), so nobody knows where the bin was; "
                "export without a background"
            )
        return cls(box, *viewpoints.draw(np.random.default_rng(0)))

    @lru_cache(maxsize=1)  # noqa: B019  a background lives as long as its export
    def depth(self, camera: Camera) -> Points:
        """See `bin_depth`; not to be written to."""
        found = bin_depth(camera, self.box, self.R, self.t)
        found.setflags(write=False)
        return found


def bin_depth(camera: Camera, box: Bin, R: Points, t: Points) -> Points:
    """Depth of an empty bin: its floor and its upright walls as thin opaque sheets, seen from either side.

    Args:
        camera: the view. box: the bin. R: (3, 3), t: (3,) world → camera, metres.
    Returns:
        (h, w) planar depth, metres; NaN where nothing is, or nothing within the camera's near and far.
    """
    v, u = np.mgrid[: camera.height, : camera.width]
    rays, origin = camera.rays(u, v) @ R, -t @ R  # world frame; the planar depth is the rays' parameter
    nearest = np.full(u.shape, np.inf)
    for axis, place, low, high in _sheets(box):
        with np.errstate(divide="ignore", invalid="ignore"):  # rays along a sheet
            z = (place - origin[axis]) / rays[..., axis]
            hit = origin + z[..., None] * rays
        # a sheet is flat along its own axis, where rounding decides nothing
        inside = (np.delete(hit - low, axis, -1) >= -SEAM) & (np.delete(high - hit, axis, -1) >= -SEAM)
        nearest = np.where(inside.all(-1) & (z > 0) & (z < nearest), z, nearest)
    return np.where((nearest >= camera.near) & (nearest <= camera.far), nearest, np.nan)


def _sheets(box: Bin) -> list[tuple[int, float, Points, Points]]:
    """Floor and walls: the axis normal to each, its place on it, the bin's least and largest corner."""
    low = np.array([-box.width / 2, -box.depth / 2, 0])
    high = np.array([box.width / 2, box.depth / 2, box.height])
    places = [(2, 0.0), (0, low[0]), (0, high[0]), (1, low[1]), (1, high[1])]
    return [(axis, float(place), low, high) for axis, place in places]
