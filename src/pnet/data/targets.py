"""Per-point labels, computed when a scene is loaded; the store keeps none of them."""

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from pnet.geometry.rigid import apply_inverse_pose, apply_pose
from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry
from pnet.parts.base import ParametricPart, Points
from pnet.parts.choice import KeypointChoice, KeypointRule
from pnet.parts.keypoints import KeypointChain
from pnet.records import Scene


def instance_keypoints(scene: Scene, chain: KeypointChain, choice: KeypointChoice) -> tuple[Tensor, Tensor]:
    """Label keypoints of every instance, under a rule that looks at the instance alone.

    Args:
        scene: d instances. chain: the part's keypoints. choice: the camera or the canonical rule.
    Returns:
        keypoints (d, m, 3) float64, camera frame, metres; margin (d, m) to the runner-up, metres.
    """
    R, t = torch.from_numpy(scene.R), torch.from_numpy(scene.t)
    local, margin = chain.select(choice, torch.from_numpy(scene.parameters), R)
    return apply_pose(R, t, local), margin


def nearest_keypoints(scene: Scene, chain: KeypointChain) -> tuple[Tensor, Tensor, Tensor]:
    """For every surface point the equivalent keypoints of its instance that are nearest to it
    (`KeypointRule.POINT`).

    Args:
        scene: N points on d instances. chain: the part's keypoints.
    Returns:
        keypoints (N, m, 3) float64, camera frame, metres; margin (N, m) to the runner-up, metres; which of
        the part's lookalikes (N,) int64.
    """
    owner = torch.from_numpy(scene.instance)
    R, t = torch.from_numpy(scene.R)[owner], torch.from_numpy(scene.t)[owner]
    points = apply_inverse_pose(R, t, torch.from_numpy(scene.points).double()[:, None])[:, 0]
    template = chain.keypoints_from_parameters(torch.from_numpy(scene.parameters))[owner]
    local, margin, which = chain.nearest(points, template)
    return apply_pose(R, t, local), margin, which


def point_labels(scene: Scene, chain: KeypointChain, choice: KeypointChoice) -> dict[str, Tensor]:
    """The labels of every point: those of the instance that it lies on.

    Args:
        scene: N points on d instances; every point lies on one.
    Returns:
        float32 tensors: points (N, 3), centroid (N, 3), keypoints (N, m, 3), margin (N, m), parameters (N, k)
        in metres, visibility (N,); and where lookalikes are exchanged lookalike (N,) int64, which of them.
    """
    owner = torch.from_numpy(scene.instance)
    if len(owner) and (int(owner.min()) < 0 or int(owner.max()) >= len(scene.R)):
        raise ValueError(f"{scene.id}: a point names instance {int(owner.max())} of {len(scene.R)}")
    exchanged = {}
    if choice.rule is KeypointRule.POINT:
        keypoints, margin, which = nearest_keypoints(scene, chain)
        if len(chain.lookalikes) > 1:
            exchanged["lookalike"] = which
    else:
        keypoints, margin = (value[owner] for value in instance_keypoints(scene, chain, choice))
    per_instance = {
        "centroid": torch.from_numpy(scene.t),
        "parameters": torch.from_numpy(scene.parameters),
        "visibility": torch.from_numpy(scene.visibility),
    }
    labels = {name: value.float()[owner] for name, value in per_instance.items()}
    points = torch.from_numpy(scene.points)
    labels |= {"points": points, "keypoints": keypoints.float(), "margin": margin.float()}
    return {**labels, **exchanged}


def pose_labels(scene: Scene, part: ParametricPart) -> dict[str, Tensor]:
    """What a method is taught that regresses the pose itself (PPR-Net).

    Args:
        scene: N points on d instances, all of one part object.
    Returns:
        float32 tensors: rotation (N, 3, 3) part → camera, one of the equivalents; scale (3, 3), see
        `pose_scale`.
    """
    rotation = torch.from_numpy(scene.R).float()[torch.from_numpy(scene.instance)]
    size = scene.parameters[0] if len(scene.parameters) else part.part_object("L", 0)
    return {"rotation": rotation, "scale": pose_scale(part, size).float()}


@lru_cache(maxsize=1024)
def _pose_scale(part: ParametricPart, parameters: tuple[float, ...]) -> Tensor:
    space = part.pose_space(np.array(parameters))
    match space.symmetry:
        case FiniteSymmetry():
            return space.frame_R.T @ space.scale @ space.frame_R
        case RevolutionSymmetry():
            return space.scale * torch.eye(3, dtype=torch.float64)
        case _:
            return torch.zeros(3, 3, dtype=torch.float64)  # turning a sphere moves nothing


def pose_scale(part: ParametricPart, parameters: Points) -> Tensor:
    """Λ of a part object, turned into the part frame: ‖(R − R') Λ‖ is the length by which two rotations of it
    differ (Brégier et al.); for a revolution λ times the identity, for a sphere zero.

    Args:
        parameters: (k,) metres.
    Returns:
        (3, 3) float64 metres.
    """
    return _pose_scale(part, tuple(parameters.tolist()))
