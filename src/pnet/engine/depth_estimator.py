"""From a depth image or a cloud to the instances in it: background, sampling, method."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
import torch
from numpy.typing import NDArray

from pnet.data.background import Background, NoBackground
from pnet.engine.method import Method
from pnet.geometry.camera import Camera
from pnet.ops.sampling import farthest_point_order
from pnet.parts.base import ParametricPart
from pnet.records import Detections

Points = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SampledCloud:
    """What an image gives the method.

    Attributes:
        points: (N, 3) float32 sampled, camera frame, metres; (0, 3) where nothing is left.
        measured: pixels or points with a measurement. kept: of these those that are not background.
        camera: of the image; None for a cloud. seconds: by stage.
    """

    points: NDArray[np.float32]
    measured: int
    kept: int
    camera: Camera | None
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Estimate:
    """The instances in one image, best score first. Poses are part → camera, metres.

    Attributes:
        detections: as the method found them. cloud: what it looked at. part: the template.
        seconds: by stage: background, sampling, network, poses.
    """

    detections: Detections
    cloud: SampledCloud
    part: ParametricPart
    seconds: dict[str, float]

    def __len__(self) -> int:
        return len(self.detections.score)

    @property
    def R(self) -> Points:  # noqa: N802  the field's name
        """(d, 3, 3) rotations."""
        return self.detections.R.cpu().double().numpy()

    @property
    def t(self) -> Points:
        """(d, 3) positions of the parts' centroids, metres."""
        return self.detections.t.cpu().double().numpy()

    @property
    def score(self) -> Points:
        """(d,) higher is surer."""
        return self.detections.score.cpu().double().numpy()

    @property
    def parameters(self) -> dict[str, Points]:
        """The parameters' values by name, (d,) each, metres; NaN where the method does not estimate them."""
        columns = self.detections.parameters.cpu().double().numpy().T
        return dict(zip(self.part.parameter_names, columns, strict=True))


class DepthEstimator:
    """Finds the instances of a part in depth images and clouds.

    Args:
        method: any. points: N that it is given, as many as in its training.
        camera: of the images where none is given with them. background: what is taken away first.
    """

    def __init__(
        self, method: Method, points: int, camera: Camera | None = None, background: Background | None = None
    ) -> None:
        self.method, self.points, self.camera = method, points, camera
        self.background = background or NoBackground()

    @property
    def part(self) -> ParametricPart:
        """The template that it finds."""
        return self.method.part

    def estimate(self, depth: NDArray[np.floating], camera: Camera | None = None) -> Estimate:
        """The instances in a depth image.

        Args:
            depth: (h, w) planar depth, metres; 0 or NaN where nothing was measured.
            camera: of the image; None: the estimator's own.
        Raises:
            ValueError: where the image does not fit the camera or holds negative depths.
        """
        return self.recover([self.prepare(depth, camera)])[0]

    def estimate_cloud(self, points: NDArray[np.floating]) -> Estimate:
        """The instances in a cloud (n, 3), camera frame (x right, y down, z forward), metres."""
        return self.recover([self.prepare_cloud(points)])[0]

    def prepare(self, depth: NDArray[np.floating], camera: Camera | None = None) -> SampledCloud:
        """The sampled points on parts of a depth image, see `estimate`."""
        camera = camera or self.camera
        if camera is None:
            raise ValueError("the image's camera is not known: give one")
        start = perf_counter()
        known = np.where(np.isfinite(depth), np.asarray(depth, np.float64), np.nan)
        cloud = camera.depth_to_points(known).reshape(-1, 3)
        with np.errstate(invalid="ignore"):  # NaN is no measurement
            pixels = np.flatnonzero((cloud[:, 2] >= camera.near) & (cloud[:, 2] <= camera.far))
        return self._sampled(cloud[pixels], pixels, camera, start)

    def prepare_cloud(self, points: NDArray[np.floating]) -> SampledCloud:
        """The sampled points on parts of a cloud, see `estimate_cloud`."""
        start = perf_counter()
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"the cloud has shape {points.shape}, expected (n, 3)")
        finite = np.asarray(points, np.float64)
        return self._sampled(finite[np.isfinite(finite).all(1)], None, None, start)

    def _sampled(
        self, cloud: Points, pixels: NDArray[np.int64] | None, camera: Camera | None, start: float
    ) -> SampledCloud:
        left = cloud[self.background(cloud, pixels, camera)]
        middle = perf_counter()
        order = farthest_point_order(left, self.points) if len(left) else np.zeros(0, np.int64)
        seconds = {"background": middle - start, "sampling": perf_counter() - middle}
        return SampledCloud(left[order].astype(np.float32), len(cloud), len(left), camera, seconds)

    def recover(self, clouds: Sequence[SampledCloud]) -> list[Estimate]:
        """The instances in prepared clouds; those with points go through the network as one batch."""
        filled = [cloud for cloud in clouds if len(cloud.points)]
        timing = self.method.timing
        before = (timing.network, timing.postprocess)
        found = iter(self._found(filled))
        spent = (timing.network - before[0], timing.postprocess - before[1])
        times = dict(zip(("network", "poses"), (s / max(len(filled), 1) for s in spent), strict=True))
        empty = self.method.estimate(torch.zeros(1, 0, 3))[0]
        estimates = []
        for cloud in clouds:
            own, more = (next(found), times) if len(cloud.points) else (empty, {})
            estimates.append(Estimate(own, cloud, self.part, {**cloud.seconds, **more}))
        return estimates

    def _found(self, clouds: Sequence[SampledCloud]) -> list[Detections]:
        if not clouds:
            return []
        return self.method.estimate(torch.from_numpy(np.stack([cloud.points for cloud in clouds])))
