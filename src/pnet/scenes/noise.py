"""What a depth sensor makes of exact points: noise and missing pixels."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pnet.geometry.camera import Camera
from pnet.scenes.edges import EDGE_REACH
from pnet.scenes.limits import require_number

Points = NDArray[np.float32]
Measured = tuple[Points, NDArray[np.bool_]]

MIN_COSINE = 0.2  # incidence beyond 78 degrees adds no more noise, it would be without bound


class SensorNoise(Protocol):
    """A depth sensor's errors, pixel by pixel: for a whole image's points or any sample of them."""

    def __call__(
        self,
        points: Points,
        incidence: NDArray[np.floating],
        edge: NDArray[np.number],
        camera: Camera,
        rng: np.random.Generator,
    ) -> Measured:
        """The points as they are measured.

        Args:
            points: (n, 3) camera frame, metres, z within the camera's range; not changed.
            incidence: (n,) cosine of the angle between viewing ray and surface normal, 0 to 1.
            edge: (n,) pixels to the nearest depth discontinuity, see `image_edges`.
            camera: takes the points. rng: drawn from as often for any n points.
        Returns:
            (n, 3) float32 points, finite and with z > 0 even where lost; (n,) which were measured at all.
        """
        ...


@dataclass(frozen=True)
class NoNoise:
    """Points as they are."""

    def __call__(
        self,
        points: Points,
        incidence: NDArray[np.floating],
        edge: NDArray[np.number],
        camera: Camera,
        rng: np.random.Generator,
    ) -> Measured:
        """See `SensorNoise`."""
        return points.astype(np.float32), np.ones(len(points), bool)


@dataclass(frozen=True)
class GaussianNoise:
    """Depth with the same error everywhere; every point is kept.

    The point moves along its viewing ray, so its pixel stays. A depth never leaves the camera's range.

    Attributes:
        sigma: standard deviation of the planar depth, metres.
    """

    sigma: float

    def __post_init__(self) -> None:
        require_number("noise.sigma", self.sigma, 0)

    def __call__(
        self,
        points: Points,
        incidence: NDArray[np.floating],
        edge: NDArray[np.number],
        camera: Camera,
        rng: np.random.Generator,
    ) -> Measured:
        """See `SensorNoise`."""
        z = points[:, 2].astype(np.float64)
        measured = np.clip(z + self.sigma * rng.standard_normal(len(points)), camera.near, camera.far)
        return (points * (measured / z)[:, None]).astype(np.float32), np.ones(len(points), bool)


@dataclass(frozen=True)
class StructuredLightNoise:
    """A sensor that triangulates: structured light or stereo with a pattern, baseline along x.

    Depth comes from the disparity d = f b / z. Its error is Gaussian, and it is read in steps, so
    σ_z = z² σ_d / (f b) (Khoshelham and Elberink, "Accuracy and Resolution of Kinect Depth Data for Indoor
    Mapping Applications", Sensors 12, 2012). Lateral noise, and depth noise that grows with the angle of
    incidence, were measured by Nguyen, Izadi and Lovell, "Modeling Kinect Sensor Noise for Improved 3D
    Reconstruction and Tracking", 3DIMPVT 2012.

    Simplified: σ_d grows as 1 / cos(incidence), down to `MIN_COSINE`, where Nguyen et al. fit a function of
    angle and distance to one device; the lateral noise is the same at all angles. Pixels err apart from
    each other, though matching windows make neighbours err alike. What the projector or the second camera
    does not see is measured all the same; so are dark, shiny and translucent surfaces. There is no bias.
    At edges pixels are missing but never lie between the surfaces. Depths that come out beyond the
    camera's range are lost.

    Attributes:
        baseline: between the two cameras, or camera and projector, metres.
        disparity_sigma: standard deviation of the disparity at normal incidence, pixels.
        disparity_step: the disparity is rounded to multiples of it, pixels; 0: not rounded.
        lateral_sigma: standard deviation of where in the image the depth was read, along u and along v,
            pixels. The point shifts sideways by as much; on a slanted surface it leaves the surface.
        max_incidence_deg: angle between ray and normal at which half of the pixels are lost, degrees.
        incidence_softness_deg: from so many degrees before it to as many after it, the lost share grows
            from 0 to 1; 0: at once.
        edge_pixels: width of the strip on either side of a discontinuity where pixels are lost, pixels.
        edge_loss: share lost in that strip. dropout: share lost anywhere.
    """

    baseline: float
    disparity_sigma: float = 0.0
    disparity_step: float = 0.0
    lateral_sigma: float = 0.0
    max_incidence_deg: float = 90.0
    incidence_softness_deg: float = 0.0
    edge_pixels: float = 0.0
    edge_loss: float = 0.0
    dropout: float = 0.0

    def __post_init__(self) -> None:
        require_number("noise.baseline", self.baseline, 0, above=True)
        for name in ("disparity_sigma", "disparity_step", "lateral_sigma"):
            require_number(f"noise.{name}", getattr(self, name), 0)
        for name in ("max_incidence_deg", "incidence_softness_deg"):
            require_number(f"noise.{name}", getattr(self, name), 0, 90)
        require_number("noise.edge_pixels", self.edge_pixels, 0, EDGE_REACH)
        for name in ("edge_loss", "dropout"):
            require_number(f"noise.{name}", getattr(self, name), 0, 1)

    def __call__(
        self,
        points: Points,
        incidence: NDArray[np.floating],
        edge: NDArray[np.number],
        camera: Camera,
        rng: np.random.Generator,
    ) -> Measured:
        """See `SensorNoise`."""
        # all draws are made, needed or not: settings leave each other's random numbers alone
        unit, chance = rng.standard_normal((3, len(points))), rng.random(len(points))
        exact = points.astype(np.float64)
        z = self._depth(exact[:, 2], incidence, unit[0], camera)
        shift = self.lateral_sigma * unit[1:].T / (camera.fx, camera.fy)
        measured = np.empty(points.shape, np.float32)
        measured[:, :2] = (exact[:, :2] / exact[:, 2:] + shift) * z[:, None]
        measured[:, 2] = z
        in_range = (measured[:, 2] >= np.float32(camera.near)) & (measured[:, 2] <= np.float32(camera.far))
        return measured, in_range & (chance >= self.lost_share(incidence, edge))

    def lost_share(self, incidence: NDArray[np.floating], edge: NDArray[np.number]) -> NDArray[np.float64]:
        """(n,) probability that a pixel is missing; arguments as in `SensorNoise`."""
        angle = np.degrees(np.arccos(np.clip(incidence, 0, 1)))
        softness = max(self.incidence_softness_deg, 1e-6)
        grazing = np.clip((angle - self.max_incidence_deg) / (2 * softness) + 0.5, 0, 1)
        at_edge = self.edge_loss * (edge < self.edge_pixels)
        return 1 - (1 - grazing) * (1 - at_edge) * (1 - self.dropout)

    def _depth(
        self,
        z: NDArray[np.float64],
        incidence: NDArray[np.floating],
        unit: NDArray[np.float64],
        camera: Camera,
    ) -> NDArray[np.float64]:
        """(n,) measured depth, metres, above 0. unit: (n,) standard normal."""
        scale = camera.fx * self.baseline
        disparity = scale / z + self.disparity_sigma * unit / np.maximum(incidence, MIN_COSINE)
        if self.disparity_step > 0:
            disparity = self.disparity_step * np.rint(disparity / self.disparity_step)
        # out of range, but neither infinite, as the depth of no disparity is, nor 0
        return scale / np.clip(disparity, scale / (2 * camera.far), 2 * scale / camera.near)


def fill_lost(kept: NDArray[np.bool_], count: int, scene: str = "the scene") -> NDArray[np.int64]:
    """Indices of as many points as asked, without the lost ones.

    Args:
        kept: (n,) which points were measured, points in farthest-point order: the first so many of those
            that are left are spread over all of them too.
        count: points wanted. scene: named in the error.
    Returns:
        (count,) the first kept points in their order; where fewer are left they come again from the
        first on, as in a view that has fewer pixels than points.
    Raises:
        ValueError: no point is kept.
    """
    left = np.flatnonzero(kept)
    if not len(left):
        raise ValueError(f"the sensor noise lost every point of {scene}; weaken what `noise` loses")
    return np.resize(left, count).astype(np.int64)
