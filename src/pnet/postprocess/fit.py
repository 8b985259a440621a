"""Pose fitting (the module M_F, equation 6): template keypoints onto the voted ones."""

import torch
from torch import Tensor

from pnet.geometry.constants import converted
from pnet.geometry.rigid import apply_inverse_pose, apply_pose, fit_rigid
from pnet.parts.keypoints import KeypointChain
from pnet.postprocess.kernels import Kernels, step


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
    return fit_template(chain, chain.keypoints_from_parameters(parameters), centroid, keypoints, weight)


def fit_template(
    chain: KeypointChain, template: Tensor, centroid: Tensor, keypoints: Tensor, weight: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """`fit_pose` of a template (..., m, 3) whose keypoints are known, part frame, metres."""
    target = torch.cat([centroid[..., None, :], keypoints], -2)
    if weight is None:
        weight = torch.ones_like(target[..., 0])
    mirrors = [converted(M, target) for M in chain.chiralities]
    fits = [_fit_chirality(chain, template, target, weight, M) for M in mirrors]
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
    columns = zip(weight.unbind(-1), [True, *chain.is_finite], strict=True)
    fixed = torch.stack([column if finite else torch.zeros_like(column) for column, finite in columns], -1)
    source = _with_centroid(template) @ mirror.mT
    R, t = _registration(source, target, fixed)
    if not all(chain.is_finite):
        observed = apply_inverse_pose(R, t, target[..., 1:, :]) @ mirror
        source = _with_centroid(chain.place_like(template, observed)) @ mirror.mT
        R, t = _registration(source, target, weight)
    error = (weight * (apply_pose(R, t, source) - target).square().sum(-1)).sum(-1)
    return R, t, error


def _registration(source: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    differentiable = source.requires_grad or target.requires_grad or weight.requires_grad
    if differentiable or target.dtype != torch.float64:
        return fit_rigid(source, target, weight)
    return fit_rigid_many(source.expand_as(target), target, weight)


@step("fits", Kernels.NUMBA, Kernels.TRITON)
def fit_rigid_many(source: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations and translations of `source` onto `target`.

    Args:
        source, target: (..., n, 3) float64, metres, of one shape. weight: (..., n) non-negative, some
            positive.
    Returns:
        R (..., 3, 3), t (..., 3) metres; see `pnet.geometry.rigid.fit_rigid`.
    """
    return fit_rigid(source, target, weight)


def _with_centroid(keypoints: Tensor) -> Tensor:
    return torch.cat([torch.zeros_like(keypoints[..., :1, :]), keypoints], -2)
