"""Per-point labels, computed when a scene is loaded; the store keeps none of them."""

import torch
from torch import Tensor

from pnet.geometry.rigid import apply_pose
from pnet.parts.keypoints import KeypointChain, KeypointChoice
from pnet.records import Scene


def instance_keypoints(scene: Scene, chain: KeypointChain, choice: KeypointChoice) -> Tensor:
    """Label keypoints of every instance.

    Args:
        scene: d instances. chain: the part's keypoints. choice: which equivalent is the label.
    Returns:
        (d, m, 3) float64, camera frame, metres.
    """
    R, t = torch.from_numpy(scene.R), torch.from_numpy(scene.t)
    local = chain.select(choice, torch.from_numpy(scene.parameters), R)
    return apply_pose(R, t, local)


def point_labels(scene: Scene, chain: KeypointChain, choice: KeypointChoice) -> dict[str, Tensor]:
    """The labels of every point: those of the instance that it lies on.

    Args:
        scene: N points on d instances; every point lies on one.
    Returns:
        float32 tensors: points (N, 3), centroid (N, 3), keypoints (N, m, 3), parameters (N, k) in
        metres, visibility (N,).
    """
    owner = torch.from_numpy(scene.instance)
    if len(owner) and (int(owner.min()) < 0 or int(owner.max()) >= len(scene.R)):
        raise ValueError(f"{scene.id}: a point names instance {int(owner.max())} of {len(scene.R)}")
    per_instance = {
        "centroid": torch.from_numpy(scene.t),
        "keypoints": instance_keypoints(scene, chain, choice),
        "parameters": torch.from_numpy(scene.parameters),
        "visibility": torch.from_numpy(scene.visibility),
    }
    labels = {name: value.float()[owner] for name, value in per_instance.items()}
    return {"points": torch.from_numpy(scene.points), **labels}
