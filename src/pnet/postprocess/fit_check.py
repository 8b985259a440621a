"""How exactly exact keypoints give the pose back: what `pnet-part` prints beside the part's own checks."""

import torch

from pnet.geometry.rigid import apply_inverse_pose, apply_pose
from pnet.geometry.symmetry import nearest_equivalent
from pnet.parts.base import ParametricPart
from pnet.parts.checks import random_instances
from pnet.parts.choice import KeypointChoice, KeypointRule, NearestToPoint
from pnet.postprocess.fit import fit_pose


def fit_error(part: ParametricPart, rule: KeypointRule, samples: int, seed: int = 0) -> tuple[float, float]:
    """Largest errors of poses fitted to exact label keypoints of random instances.

    Args:
        part: the template. rule: which equivalent is the label; under `point` the nearest to a random
            direction's surface point. samples: random (parameters, pose) pairs. seed: of them.
    Returns:
        rotation error modulo the part's symmetry, radians (the largest difference of a matrix entry, which is
        accurate for small angles), and position error, metres.
    """
    parameters, R, t = random_instances(part, samples, seed)
    if rule is KeypointRule.POINT:
        generator = torch.Generator().manual_seed(seed)
        direction = torch.randn(samples, 3, dtype=torch.float64, generator=generator)
        template = part.chain.keypoints_from_parameters(parameters)
        reach = torch.linalg.vector_norm(template, dim=-1).amax(-1, keepdim=True)
        points = reach * torch.nn.functional.normalize(direction, dim=-1)
        local = part.chain.choose(NearestToPoint(points), template)[0]
    else:
        local, _ = part.chain.select(KeypointChoice(rule), parameters, R)
    found_R, found_t = fit_pose(part.chain, parameters, t, apply_pose(R, t, local))
    gap = nearest_equivalent(found_R, R, part.symmetry) - R
    off = apply_inverse_pose(R, t, found_t[:, None])
    return float(gap.abs().max()), float(torch.linalg.vector_norm(off, dim=-1).max())
