"""What of a true pose may make it hard to find, and how far its best result is from it."""

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import roma
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from pnet.data.targets import instance_keypoints, nearest_keypoints
from pnet.geometry.pose_space import PoseSpace
from pnet.geometry.symmetry import SphericalSymmetry, Symmetry, nearest_equivalent
from pnet.metrics.pose_error import axis_error, position_error
from pnet.parts.base import ParametricPart
from pnet.parts.choice import KeypointChoice, KeypointRule
from pnet.parts.keypoints import KeypointChain
from pnet.records import Scene

Floats = NDArray[np.float64]
FLIP = math.radians(60)  # a larger rotation error is a flip


class Blame(IntEnum):
    """Which part of a pose puts it beyond the threshold: what alone would mend it.

    POSITION, ROTATION: that one is beyond it alone, the other is not. BOTH: each is beyond it alone, mending
    one would not do. SUM: neither is, only both together; mending either would do. NONE: it is within.
    """

    NONE = 0
    POSITION = 1
    ROTATION = 2
    BOTH = 3
    SUM = 4

    @property
    def label(self) -> str:
        """Its name for people."""
        return self.name.lower()


@dataclass(frozen=True, eq=False)
class Attributes:
    """Of n true poses.

    Attributes:
        visibility, occlusion: (n,) as in `Scene`.
        tilt: (n,) angle between the part's z axis, without sign, and the line of sight to its centroid,
            radians in [0, π/2]; NaN for a sphere.
        neighbour: (n,) from its centroid to the nearest other body's, metres; NaN for a single body.
        parameters: (n, k) metres.
        margin: (n, m) of its label keypoints, metres, see `KeypointChain.choose`; infinite where there is no
            other equivalent, NaN where a rule by points has no point.
    """

    visibility: Floats
    occlusion: Floats
    tilt: Floats
    neighbour: Floats
    parameters: Floats
    margin: Floats


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Of n true poses' best results; NaN where there is none.

    Attributes:
        distance: (n,) pose distance, threshold: (n,) the largest of a match, metres.
        position: (n,) between the surface centroids, metres; this is the pose distance that would be left
            if the rotation were right. rotation_distance: (n,) that with the right position.
        rotation: (n,) angle modulo symmetry, radians. turn: (n, 3) the smallest rotation that is left modulo
            symmetry, as a rotation vector in the part frame, radians: about which axis it is wrong.
        blame: (n,) of `Blame`.
    """

    distance: Floats
    threshold: Floats
    position: Floats
    rotation_distance: Floats
    rotation: Floats
    turn: Floats
    blame: NDArray[np.int64]

    @property
    def flip(self) -> NDArray[np.bool_]:
        """(n,) whether the rotation is more than 60 degrees off, modulo symmetry."""
        return self.rotation > FLIP


def scene_attributes(scene: Scene, part: ParametricPart, choice: KeypointChoice) -> Attributes:
    """Of all d bodies of a scene.

    Args:
        choice: the rule of the label keypoints. scene: cut to the points that a method was given.
    """
    sight = scene.t / np.linalg.norm(scene.t, axis=1, keepdims=True).clip(1e-12)
    cosine = np.abs(np.einsum("ij,ij->i", scene.R[:, :, 2], sight)).clip(0, 1)
    tilt = (
        np.full(len(scene.t), np.nan) if isinstance(part.symmetry, SphericalSymmetry) else np.arccos(cosine)
    )
    neighbour = np.full(len(scene.t), np.nan)
    if len(scene.t) > 1:
        neighbour = cKDTree(scene.t).query(scene.t, 2)[0][:, 1]
    margin = label_margin(scene, part.chain, choice)
    return Attributes(scene.visibility, scene.occlusion, tilt, neighbour, scene.parameters, margin)


def label_margin(scene: Scene, chain: KeypointChain, choice: KeypointChoice) -> Floats:
    """(d, m) ambiguity margins of the label keypoints, metres; under the rule by points their medians."""
    if choice.rule is not KeypointRule.POINT:
        return instance_keypoints(scene, chain, choice)[1].numpy()
    known = scene.instance >= 0
    seen = replace(scene, points=scene.points[known], instance=scene.instance[known])
    margin = np.full((len(scene.R), len(chain)), np.nan)
    if len(seen.points):
        each = nearest_keypoints(seen, chain)[1].numpy()
        for body in np.unique(seen.instance):
            margin[body] = np.median(each[seen.instance == body], 0)
    return margin


def pose_errors(
    space: PoseSpace, symmetry: Symmetry, Ra: Tensor, ta: Tensor, Rb: Tensor, tb: Tensor
) -> PoseErrors:
    """Errors of results Rb (n, 3, 3), tb (n, 3) of true poses Ra, ta; NaN poses give NaN and no blame.

    Args:
        symmetry: of the part, in the part frame.
    """
    shift = ((Ra - Rb) @ space.centre[:, None])[..., 0]  # brings the turned body's centre to the true one
    columns = (
        space.distance(Ra, ta, Rb, tb),
        torch.full((len(Ra),), space.distance_threshold, dtype=torch.float64),
        position_error(space, Ra, ta, Rb, tb),
        space.distance(Ra, ta, Rb, ta + shift),
        axis_error(space, Ra, Rb),
        roma.rotmat_to_rotvec(Ra.mT @ nearest_equivalent(Rb, Ra, symmetry)),
    )
    distance, threshold, position, rotation_distance, rotation, turn = (x.numpy() for x in columns)
    return PoseErrors(
        distance,
        threshold,
        position,
        rotation_distance,
        rotation,
        np.where(np.isnan(rotation)[:, None], np.nan, turn),
        _blame(distance > threshold, position > threshold, rotation_distance > threshold),
    )


def _blame(
    beyond: NDArray[np.bool_], position: NDArray[np.bool_], rotation: NDArray[np.bool_]
) -> NDArray[np.int64]:
    return np.select(
        [~beyond, position & rotation, position, rotation],
        [Blame.NONE, Blame.BOTH, Blame.POSITION, Blame.ROTATION],
        Blame.SUM,
    ).astype(np.int64)
