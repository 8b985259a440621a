"""Pose representatives and the symmetry-aware pose distance of Brégier et al. (2017), the paper's [21].

A pose of a symmetric body is a set of points in a Euclidean space, its representatives; the distance of
two poses is the smallest distance between their representatives. It is a length: the root mean square
displacement of the body's surface, minimised over the symmetry.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry, Symmetry


@dataclass(frozen=True, eq=False)
class PoseSpace:
    """What turns a pose of one body into representatives.

    Attributes:
        symmetry: the body's proper symmetry group, in the inertial frame.
        scale: (3, 3) float64 Λ for a finite group; () λ for a revolution; ignored for a sphere. Metres.
        frame_R: (3, 3) and
        frame_t: (3,): x_inertial = frame_R x_body + frame_t (the benchmark's Rref2i, tref2i), metres.
        distance_threshold: largest distance of a match, metres.
    Note:
        A revolution's axis is the body's own z, so only its centre is taken from the frame.
    """

    symmetry: Symmetry
    scale: Tensor
    frame_R: Tensor
    frame_t: Tensor
    distance_threshold: float

    @property
    def centre(self) -> Tensor:
        """(3,) surface centroid in the body frame, metres."""
        return -self.frame_R.T @ self.frame_t

    def representatives(self, R: Tensor, t: Tensor) -> Tensor:
        """All representatives of each pose.

        Args:
            R: (..., 3, 3), t: (..., 3) metres; body → any common frame.
        Returns:
            (..., g, D) float64 metres: finite g = |G|, D = 12; revolution g = 1 or 2, D = 6; sphere 1, 3.
        """
        R, t = R.double(), t.double()
        position = t + R @ self.centre
        match self.symmetry:
            case FiniteSymmetry(rotations=G):
                turned = (R @ self.frame_R.T)[..., None, :, :] @ G @ self.scale
                shape = turned.flatten(-2)
            case RevolutionSymmetry(rotoreflection=reflected):
                axis = self.scale * R[..., None, :, 2]
                shape = torch.cat([axis, -axis], -2) if reflected else axis
            case _:
                shape = position[..., None, :0]
        place = position[..., None, :].expand(*shape.shape[:-1], 3)
        return torch.cat([shape, place], -1)

    def distance(self, Ra: Tensor, ta: Tensor, Rb: Tensor, tb: Tensor) -> Tensor:
        """Distance of poses that are paired by broadcasting (Brégier's eq. for each symmetry class).

        Args:
            Ra, Rb: (..., 3, 3); ta, tb: (..., 3) metres.
        Returns:
            (...) metres.
        """
        first = self.representatives(Ra, ta)[..., :1, :]
        return torch.linalg.vector_norm(first - self.representatives(Rb, tb), dim=-1).amin(-1)

    def pairwise_distance(self, Ra: Tensor, ta: Tensor, Rb: Tensor, tb: Tensor) -> Tensor:
        """Distance of every pose of one set to every pose of another.

        Args:
            Ra: (n, 3, 3), ta: (n, 3); Rb: (m, 3, 3), tb: (m, 3) metres.
        Returns:
            (n, m) metres.
        """
        first = self.representatives(Ra, ta)[:, 0]
        others = self.representatives(Rb, tb)
        flat = torch.cdist(first, others.flatten(0, 1), compute_mode="donot_use_mm_for_euclid_dist")
        return flat.unflatten(1, others.shape[:2]).amin(-1) if len(Rb) else flat
