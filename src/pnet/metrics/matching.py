"""Ties the results of a scene to its true poses (Brégier et al. 2017)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from pnet.geometry.pose_space import PoseSpace


@dataclass(frozen=True, eq=False)
class TruePoses:
    """The true poses of one scene, held as float64 on the CPU.

    Attributes:
        R: (n, 3, 3), t: (n, 3) metres; body → the frame that the results use.
        occlusion: (n,) 1 − visible share of the body's own silhouette.
    """

    R: Tensor
    t: Tensor
    occlusion: Tensor

    def __post_init__(self) -> None:
        _hold(self, "true poses", ("R", "t", "occlusion"))


@dataclass(frozen=True, eq=False)
class ScoredPoses:
    """The results of one scene in any order, held as float64 on the CPU.

    Attributes:
        R: (n, 3, 3), t: (n, 3) metres; body → the frame that the true poses use.
        score: (n,) higher is surer; only the order matters.
    """

    R: Tensor
    t: Tensor
    score: Tensor

    def __post_init__(self) -> None:
        _hold(self, "scored poses", ("R", "t", "score"))


@dataclass(frozen=True, eq=False)
class SceneMatch:
    """What precision and recall need to know of one scene with n results and m true poses.

    Attributes:
        score: (n,) float64.
        truth: (n,) int64 index of the nearest true pose, −1 in a scene without any.
        distance: (n,) float64 metres to it, inf in a scene without any.
        matched: (n,) bool, the distance is within the threshold.
        relevant: (m,) bool, the true pose is visible enough to be asked for.
    """

    score: Tensor
    truth: Tensor
    distance: Tensor
    matched: Tensor
    relevant: Tensor


def match_scene(
    space: PoseSpace, truth: TruePoses, results: ScoredPoses, max_occlusion: float = 0.5
) -> SceneMatch:
    """Tie each result to its nearest true pose; several results may be tied to the same one.

    Args:
        space: the body's pose distance and threshold.
        max_occlusion: a true pose that is more occluded than this counts neither way.
    """
    relevant = truth.occlusion <= max_occlusion
    if len(truth.t) == 0:
        nearest = torch.full_like(results.score, -1, dtype=torch.int64)
        distance = torch.full_like(results.score, torch.inf)
    else:
        pairwise = space.pairwise_distance(results.R, results.t, truth.R, truth.t)
        distance, nearest = pairwise.min(1)
    matched = distance <= space.distance_threshold
    return SceneMatch(results.score, nearest, distance, matched, relevant)


def nearest_matches(match: SceneMatch) -> tuple[Tensor, Tensor]:
    """The best result for each relevant true pose that has one, for statistics of the pose error.

    Returns:
        Indices (k,) of true poses, ascending, and (k,) of the nearest result matched with each.
    """
    candidate = match.matched.nonzero()[:, 0]
    candidate = candidate[match.relevant[match.truth[candidate]]]
    candidate = candidate[match.distance[candidate].argsort(stable=True)]
    candidate = candidate[match.truth[candidate].argsort(stable=True)]
    truth = match.truth[candidate]
    first = torch.ones_like(truth, dtype=torch.bool)
    first[1:] = truth[1:] != truth[:-1]
    return truth[first], candidate[first]


def _hold(poses: TruePoses | ScoredPoses, what: str, names: tuple[str, str, str]) -> None:
    """Convert the fields of a record and check their shapes and values."""
    R, t, value = (
        torch.as_tensor(getattr(poses, name), dtype=torch.float64, device="cpu").detach() for name in names
    )
    n = len(t) if t.ndim else 0
    for name, field, shape in zip(names, (R, t, value), ((n, 3, 3), (n, 3), (n,)), strict=True):
        if field.shape != shape:
            raise ValueError(f"{what}: {name} has shape {tuple(field.shape)}, expected {shape} for {n} poses")
        if bool(field.isnan().any()):
            raise ValueError(f"{what}: {name} holds NaN, expected numbers only")
        object.__setattr__(poses, name, field)
