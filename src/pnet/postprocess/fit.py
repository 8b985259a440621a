"""Pose fitting (the module M_F, equation 6): template keypoints onto the voted ones."""

import torch
from torch import Tensor

from pnet.geometry.rigid import apply_inverse_pose, apply_pose, fit_rigid
from pnet.parts.keypoints import KeypointChain


def fit_pose(
    chain: KeypointChain,
    parameters: Tensor,
    centroid: Tensor,
    keypoints: Tensor,
    weight: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Fit the template to every instance; with two chiralities the one with the smaller error.

    Args:
        chain: the part's keypoints.
        parameters: (..., k), broadcast against the others. centroid: (..., 3), keypoints: (..., m, 3) camera
            frame, metres.
        weight: (..., 1 + m) trust in the centroid and each keypoint, or None for equation 6's equal weights.
    Returns:
        R (..., 3, 3), t (..., 3) part → camera, metres.
    """
    target = torch.cat([centroid[..., None, :], keypoints], -2)
    if weight is None:
        weight = torch.ones_like(target[..., 0])
    template = chain.keypoints_from_parameters(parameters)
    fits = [_fit_chirality(chain, template, target, weight, M.to(target)) for M in chain.chiralities]
    R, t, error = fits[0]
    for other_R, other_t, other_error in fits[1:]:
        better = other_error < error
        R = torch.where(better[..., None, None], other_R, R)
        t = torch.where(better[..., None], other_t, t)
    return R, t


def _fit_chirality(
    chain: KeypointChain, template: Tensor, target: Tensor, weight: Tensor, mirror: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Fit the template seen through `mirror`: the identity or an improper symmetry.

    Keypoints on circles and spheres carry no knowledge of the pose about their axis: a first fit leaves
    them out, then each is placed on its circle where the observation has it. So the template matches
    the labels' geometry exactly, whatever the view.
    """
    finite = target.new_tensor([1.0, *map(float, chain.is_finite)])
    source = _with_centroid(template) @ mirror.mT
    R, t = _registration(source, target, weight * finite)
    if not all(chain.is_finite):
        observed = apply_inverse_pose(R, t, target[..., 1:, :]) @ mirror
        source = _with_centroid(chain.place_like(template, observed)) @ mirror.mT
        R, t = _registration(source, target, weight)
    error = (weight * (apply_pose(R, t, source) - target).square().sum(-1)).sum(-1)
    return R, t, error


def _registration(source: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    plain = source.requires_grad or target.requires_grad or weight.requires_grad
    if target.device.type == "cpu" and target.dtype == torch.float64 and not plain:
        from pnet.postprocess.rigid_fits import fit_rigid_many

        return fit_rigid_many(source.expand_as(target), target, weight)
    return fit_rigid(source, target, weight)


def _with_centroid(keypoints: Tensor) -> Tensor:
    return torch.cat([torch.zeros_like(keypoints[..., :1, :]), keypoints], -2)
