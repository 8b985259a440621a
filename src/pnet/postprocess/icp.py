"""Refinement of poses against the cloud by generalised ICP (Segal et al., RSS 2009), with small_gicp."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnet.geometry.rigid import rotation_angle
from pnet.geometry.symmetry import nearest_equivalent
from pnet.parts.base import ParametricPart, Points
from pnet.postprocess.surface import Surface, sample_surface
from pnet.records import Detections

Pose = tuple[Points, Points]
NEIGHBOURS = 8  # points that tell the direction of the surface at one of them
LEAST = 11  # points that the library wants in a cloud
ROUNDS = 2  # registrations, each from the last one's pose and without the strays that it shows
STRAY = 4.5  # medians of the distance to the surface beyond which a point is a stray: 3 σ of Gaussian noise
CLOSE = 0.05  # no point is a stray within this share of max_distance: without noise the median is nothing
TRUSTED = 0.8  # share of a cluster's points that judge a pose: the nearest to the surface
MAX_TURN = math.radians(15)  # a larger turn is another fit, not a refinement
STEP = {"rotation_epsilon": 1e-4, "translation_epsilon": 1e-6}  # radians, metres; smaller ones are the last


@dataclass(frozen=True)
class IcpRefinement:
    """Registers every cluster onto that side of its part's surface that its pose turns to the camera.

    The cluster's points are the source and samples of the surface the target: every measured point lies on
    the part, while much of the part is hidden. Back faces are left out: behind a thin wall or inside a hole
    they are nearer to a displaced point than the face that it was measured on.

    The residual that has to fall is the root mean square distance of the points from the tangent planes of
    their nearest samples, none counted as more than `max_distance`, of the nearest 80% of the points.

    Attributes:
        model_points: samples of the part's surface.
        max_distance: largest distance of a correspondence, and largest shift of a pose, metres.
        iterations: at most so many steps of each of two registrations.
        min_points: clusters with fewer points, or fewer than 11, keep their pose.
    """

    model_points: int
    max_distance: float
    iterations: int
    min_points: int

    def __call__(
        self, part: ParametricPart, parameters: Tensor, R: Tensor, t: Tensor, points: Tensor, owner: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Refine every pose that its cluster's points fit better elsewhere nearby; the others stay.

        Args:
            part: the template. parameters: (d, k) metres. R: (d, 3, 3), t: (d, 3) part → camera, metres.
            points: (N, 3) camera frame, metres. owner: (N,) cluster in [0, d), −1 for none.
        Returns:
            R (d, 3, 3), t (d, 3) float64, metres.
        Raises:
            ValueError: where parameters are NaN.
            ModuleNotFoundError: without the extra [icp].
        """
        if bool(parameters.isnan().any()):
            raise ValueError(
                "ICP needs the part's size: this method does not estimate it; use a part with one part "
                "object, or a method that estimates parameters"
            )
        gicp = _small_gicp()
        R, t = (x.detach().cpu().double().clone() for x in (R, t))
        clouds = _by_owner(points.detach().cpu().double().numpy(), owner.cpu().numpy(), len(R))
        for i, (size, own) in enumerate(zip(parameters.tolist(), clouds, strict=True)):
            own = own[np.isfinite(own).all(1)]
            if len(own) >= max(self.min_points, LEAST):
                surface = sample_surface(part, tuple(size), self.model_points)
                found = surface and self._fit(gicp, surface, R[i].numpy(), t[i].numpy(), own)
                if found:
                    R[i], t[i] = self._plausible(part, R[i], t[i], *map(torch.from_numpy, found))
        return R, t

    def refined(
        self, part: ParametricPart, found: Detections, points: Tensor, scenes: Sequence[int]
    ) -> Detections:
        """See `Refinement`: better poses, the rest as it is."""
        cloud, owner = points.flatten(0, 1).cpu().double(), found.instance.flatten()
        R, t = self(part, found.parameters, found.R, found.t, cloud, owner)
        return replace(found, R=R, t=t)

    def _fit(self, gicp: Any, surface: Surface, R: Points, t: Points, own: Points) -> Pose | None:
        """The pose of one cluster (n, 3) where its residual is lower than at R (3, 3), t (3,), else None.

        A registration finds Q, q that carry the cluster in the part frame, x = Rᵀ (p − t), to Q x + q on the
        surface. With R' = R Qᵀ and t' = t − R' q that is R'ᵀ (p − t'), so (R', t') is the new pose.
        """
        if not (np.isfinite(R).all() and np.isfinite(t).all()):
            return None
        seen, local = surface.facing(R, t), (own - t) @ R
        if len(seen.points) < LEAST:
            return None
        target = _Target(gicp, seen, self.max_distance)
        Q, q = self._register(gicp, target, local)
        if not residual(target.distances(local @ Q.T + q)) < residual(target.distances(local)):
            return None
        turned = R @ Q.T
        return turned, t - turned @ q

    def _plausible(
        self, part: ParametricPart, R: Tensor, t: Tensor, found_R: Tensor, found_t: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The found pose, as the equivalent nearest to the first; the first where that is too far off.

        No point holds a revolution's turn about its axis, so a good fit may have turned it by any angle.
        """
        nearest = nearest_equivalent(found_R, R, part.symmetry)
        shift = torch.linalg.vector_norm(found_t - t)
        near = bool(shift <= self.max_distance) and bool(rotation_angle(nearest, R) <= MAX_TURN)
        return (nearest, found_t) if near else (R, t)

    def _register(self, gicp: Any, target: "_Target", local: Points) -> Pose:
        """Rotation (3, 3) and translation (3,) of points (n, 3) onto the target, part frame, metres."""
        limits = {"max_correspondence_distance": self.max_distance, "max_iterations": self.iterations, **STEP}
        move, used = np.eye(4), local
        for _ in range(ROUNDS):
            source = gicp.PointCloud(used)
            gicp.estimate_covariances(source, num_neighbors=NEIGHBOURS)
            found = gicp.align(target.cloud, source, target.tree, move, "GICP", num_threads=1, **limits)
            move = found.T_target_source
            off = target.distances(local @ move[:3, :3].T + move[:3, 3])
            used = local[off <= max(STRAY * np.median(off), CLOSE * self.max_distance)]
            if len(used) < LEAST:
                break
        return move[:3, :3], move[:3, 3]


def _by_owner(cloud: Points, owner: NDArray[np.int64], d: int) -> list[Points]:
    """The points (n, 3) of each of d clusters, in their order. owner: (n,) cluster, −1 for none."""
    order = np.argsort(owner, kind="stable")
    return np.split(cloud[order], np.searchsorted(owner[order], np.arange(d + 1)))[1:-1]


class _Target:
    """A surface as the library wants it: directions out of neighbours, as it takes no given normals."""

    def __init__(self, gicp: Any, surface: Surface, max_distance: float) -> None:
        """gicp: the library. max_distance: see `distances`, metres."""
        self.surface, self.max_distance = surface, max_distance
        self.cloud = gicp.PointCloud(surface.points)
        self.tree = gicp.KdTree(self.cloud)
        gicp.estimate_covariances(self.cloud, self.tree, num_neighbors=NEIGHBOURS)

    def distances(self, local: Points) -> Points:
        """Distance of points (n, 3), part frame, from the tangent planes of their nearest samples.

        Returns:
            (n,) metres; at most `max_distance`, and that where the sample itself is farther.
        """
        nearest, square = map(np.asarray, self.tree.batch_nearest_neighbor_search(local))
        off = local - self.surface.points[nearest]
        plane = np.abs((off * self.surface.normals[nearest]).sum(1))
        return np.where(square <= self.max_distance**2, plane, self.max_distance)


def residual(distances: NDArray[np.float64]) -> float:
    """Root mean square of the smallest 80% of distances (n,): strays of other bodies don't judge a pose."""
    count = max(int(TRUSTED * len(distances)), 1)
    return float(np.sqrt(np.mean(np.partition(distances, count - 1)[:count] ** 2)))


def _small_gicp() -> Any:
    try:
        import small_gicp
    except ModuleNotFoundError as fault:
        raise ModuleNotFoundError(
            'refinement by ICP needs the package small_gicp: pip install "pnet[icp]", or leave it out'
        ) from fault
    return small_gicp
