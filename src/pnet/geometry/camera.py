"""The pinhole camera: pixels, rays and depth."""

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Camera:
    """Pinhole camera; frame x right, y down, z forward; pixel (0, 0) has its centre at u = v = 0.

    Attributes:
        width, height: image size, pixels.
        fx, fy: focal lengths, pixels. cx, cy: principal point, pixels.
        near, far: planar depth that the sensor can measure, metres.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    near: float = 0.1
    far: float = 10.0

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera image is {self.width} x {self.height}, expected at least 1 x 1")
        if not np.isfinite([self.fx, self.fy, self.cx, self.cy]).all():
            raise ValueError(f"camera has values that are NaN or infinite: {self}")
        if self.fx <= 0 or self.fy <= 0:
            raise ValueError(f"camera focal lengths fx={self.fx}, fy={self.fy} must be positive")
        if not 0 < self.near < self.far:
            raise ValueError(f"camera near ({self.near}) must be positive and below far ({self.far})")

    def to_dict(self) -> dict[str, float]:
        """Plain numbers, for a file header."""
        return asdict(self)

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Pixel coordinates of points.

        Args:
            points: (..., 3) camera frame, metres, z > 0.
        Returns:
            (..., 2) u, v in pixels.
        """
        x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], -1)

    def rays(self, u: NDArray[np.number], v: NDArray[np.number]) -> NDArray[np.float64]:
        """Viewing directions with z = 1, so that depth times direction is the point.

        Args:
            u, v: (...) pixels.
        Returns:
            (..., 3) camera frame.
        """
        u, v = np.asarray(u, np.float64), np.asarray(v, np.float64)
        return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones_like(u)], -1)

    def ray_lengths(self) -> NDArray[np.float64]:
        """(height, width) lengths of the pixels' rays with z = 1: distance over planar depth."""
        x = (np.arange(self.width) - self.cx) / self.fx
        y = (np.arange(self.height) - self.cy) / self.fy
        lengths: NDArray[np.float64] = np.sqrt(1 + x**2 + (y**2)[:, None])
        return lengths

    def depth_to_points(self, depth: NDArray[np.floating]) -> NDArray[np.float64]:
        """Back-project a planar depth image.

        Args:
            depth: (height, width) metres; NaN or 0 where nothing was measured.
        Returns:
            (height, width, 3) camera frame, metres.
        """
        if depth.shape != (self.height, self.width):
            raise ValueError(
                f"depth image has shape {depth.shape}, the camera expects {(self.height, self.width)}"
            )
        if (depth < 0).any():
            raise ValueError(f"depth image has negative values (lowest {np.nanmin(depth):g} m)")
        v, u = np.mgrid[: self.height, : self.width]
        return self.rays(u, v) * depth[..., None]
